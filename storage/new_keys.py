"""What a key of the API looks like: a prefix that scanners for leaked keys know, 256 random bits.

Without the database, so that whoever starts a service can make its first key.
"""

from __future__ import annotations

import secrets

KEY_PREFIX = "nw_"


def new_api_key() -> str:
    """A key that nobody has seen."""
    return KEY_PREFIX + secrets.token_urlsafe(32)
