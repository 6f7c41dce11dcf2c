from tests.threads import two_threads

__all__ = ["two_threads"]
