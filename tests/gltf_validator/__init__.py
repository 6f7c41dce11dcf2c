"""What the Khronos glTF validator says of a file. It lies beside this one, and runs in Node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.node import told_by_node

_PROGRAM = """
const validator = require(process.argv[1]);
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[2]));
validator.validateBytes(bytes, {maxIssues: 0, writeTimestamp: false}).then(
  (report) => console.log(JSON.stringify(report)),
  (error) => { console.error(String(error)); process.exit(1); },
);
"""
_VALIDATOR = Path(__file__).with_name("gltf_validator.dart.js")
_ERROR, _WARNING = 0, 1


def report_of(path: Path) -> dict[str, Any]:
    """Its report. Raises CalledProcessError for what it takes for no glTF at all."""
    report: dict[str, Any] = told_by_node(_PROGRAM, str(_VALIDATOR), str(path), timeout_s=60)
    return report


def problems_of(path: Path) -> list[str]:
    """Its errors and warnings; there must be none."""
    return [
        f"{message['code']} at {message.get('pointer', '')}: {message['message']}"
        for message in report_of(path)["issues"]["messages"]
        if message["severity"] in (_ERROR, _WARNING)
    ]
