"""`python -m worker`, which says that it has a GPU."""

from __future__ import annotations

from unittest.mock import patch

from worker.__main__ import main

if __name__ == "__main__":
    with patch("worker.__main__.detect_gpu", lambda: True):
        main()
