"""XML from strangers: elements, attributes and text, and nothing that XML can do beyond that.

A document type declaration is refused as such, so there are no entities: none to expand a thousand
times, none that names a file or an address. Depth and number of elements are bounded. Standard
library only.
"""

from __future__ import annotations

from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from pipelines.captures.parsing import malformed
from pipelines.errors import CaptureError

MOST_DEPTH = 64
MOST_ELEMENTS = 2_000_000


def parse_xml(data: bytes, file: str) -> Element:
    """The root element. file: what messages call it. Raises CaptureError poses_malformed."""
    builder = TreeBuilder()
    depth = count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MOST_DEPTH or count > MOST_ELEMENTS:
            raise malformed(f"{file} has too many elements, or too deep ones.")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> NoReturn:
        raise malformed(
            f"{file} has a document type declaration, which could hold entities.",
            "Send the file as the program wrote it; such files need no DOCTYPE.",
        )

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except CaptureError:
        raise
    except (expat.ExpatError, AssertionError, ValueError, LookupError) as error:
        raise malformed(f"{file} is no readable XML: {error}.") from error
