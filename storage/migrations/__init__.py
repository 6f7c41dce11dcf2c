from storage.schema import upgrade

__all__ = ["upgrade"]
