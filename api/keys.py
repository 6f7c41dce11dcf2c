"""`python -m api.keys`: who may call the API. Lists keys, adds one, makes one invalid.

It works on the database that NERFWORKS_HOME or NERFWORKS_DATABASE_URL names, as the service does,
while that runs or not. Keys themselves are not kept: a new one is printed once.
"""

from __future__ import annotations

import argparse
import sys
from datetime import datetime
from pathlib import Path

from sqlalchemy import make_url
from sqlalchemy.exc import DBAPIError

from storage.api_keys import BOOTSTRAP, create_api_key, list_api_keys, revoke_api_key
from storage.db import Database
from storage.errors import NotFoundError
from storage.models import ApiKey
from storage.settings import StorageSettings

MAX_NAME_CHARS = 100
COLUMNS = ("ID", "CREATED", "LAST USED", "REVOKED", "NAME")


def _name(text: str) -> str:
    if not 1 <= len(text.strip()) <= MAX_NAME_CHARS or not text.isprintable():
        raise argparse.ArgumentTypeError(f"a name has 1 to {MAX_NAME_CHARS} characters")
    if text.strip() == BOOTSTRAP:
        raise argparse.ArgumentTypeError(f"{BOOTSTRAP} is the name of the settings' key")
    return text.strip()


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m api.keys", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="all keys, the oldest first")
    add = commands.add_parser("add", help="make a key and print it, once")
    add.add_argument("name", type=_name, metavar="NAME", help="whose it is, for the list")
    revoke = commands.add_parser("revoke", help="make a key invalid, for good")
    revoke.add_argument("id", metavar="ID", help="as the list names it")
    return parser.parse_args(arguments)


def _when(moment: datetime | None) -> str:
    return "-" if moment is None else f"{moment:%Y-%m-%d %H:%M}Z"


def table(keys: list[ApiKey]) -> str:
    """A line for each key below the columns' names; times are UTC."""
    rows = [
        COLUMNS,
        *(
            (
                key.id,
                _when(key.created_at),
                _when(key.last_used_at),
                _when(key.revoked_at),
                key.name,
            )
            for key in keys
        ),
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(COLUMNS))]
    lines = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
    return "\n".join(lines)


def run(database: Database, options: argparse.Namespace) -> None:
    """Do what was asked for and print the answer. Raises NotFoundError, sqlalchemy's errors."""
    if options.command == "list":
        with database.read_scope() as session:
            keys = list_api_keys(session)
        print(table(keys))
    elif options.command == "add":
        with database.session_scope() as session:
            record, key = create_api_key(session, options.name)
        print(f"Key {record.id} for {record.name}; it cannot be shown again:", file=sys.stderr)
        print(key)
    else:
        with database.session_scope() as session:
            record = revoke_api_key(session, options.id)
        print(f"Key {record.id} ({record.name}) is invalid.")
        if record.name == BOOTSTRAP:
            print("Set another one before the API starts again, or do without.")


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Returns the process's exit status."""
    options = parse(arguments)
    url = make_url(StorageSettings().resolved_database_url)
    if url.get_backend_name() == "sqlite" and not Path(url.database or "").is_file():
        print(
            f"There is no service's database at {url.database}. Run this where the service runs, "
            "or set NERFWORKS_HOME or NERFWORKS_DATABASE_URL as it has them.",
            file=sys.stderr,
        )
        return 1
    database = Database(url.render_as_string(hide_password=False))
    try:
        run(database, options)
    except NotFoundError as error:
        print(f"{error} See `python -m api.keys list`.", file=sys.stderr)
        return 1
    except DBAPIError as error:
        print(f"The database cannot be used: {error.orig}", file=sys.stderr)
        return 1
    finally:
        database.dispose()
    return 0


if __name__ == "__main__":
    sys.exit(main())
