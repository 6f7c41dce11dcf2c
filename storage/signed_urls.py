"""The last part of a local signed URL: which object, as what, until when; not to be forged.

The local store makes them, the API serves them (`/v1/objects/{token}`).
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import time
from dataclasses import dataclass, fields

from storage.errors import InvalidUrlError


@dataclass(frozen=True)
class SignedObject:
    """What a local signed URL allows: reading one object, as a download of this name and type.

    sha256: of its content, "" where who signed did not know.
    """

    key: str
    filename: str
    media_type: str
    expires_at: int
    sha256: str = ""


def make_object_token(signing_key: bytes, signed: SignedObject) -> str:
    """The last part of a local signed URL."""
    payload = json.dumps(
        [signed.key, signed.filename, signed.media_type, signed.expires_at, signed.sha256],
        separators=(",", ":"),
    ).encode()
    mac = hmac.digest(signing_key, b"nerfworks object url\0" + payload, hashlib.sha256)
    return ".".join(base64.urlsafe_b64encode(part).decode().rstrip("=") for part in (payload, mac))


def verify_object_token(signing_key: bytes, token: str, now_s: float | None = None) -> SignedObject:
    """What a token allows. Raises InvalidUrlError for one that is forged or has expired."""
    try:
        payload, mac = (
            base64.b64decode(part + "=" * (-len(part) % 4), altchars=b"-_", validate=True)
            for part in token.split(".")
        )
    except (ValueError, binascii.Error) as error:
        raise InvalidUrlError("This download link is damaged.") from error
    expected = hmac.digest(signing_key, b"nerfworks object url\0" + payload, hashlib.sha256)
    if not hmac.compare_digest(mac, expected):
        raise InvalidUrlError("This download link is not valid.")
    known = len(fields(SignedObject))
    signed = SignedObject(*json.loads(payload)[:known])  # a later version may say more
    if (time.time() if now_s is None else now_s) > signed.expires_at:
        raise InvalidUrlError("This download link has expired.")
    return signed
