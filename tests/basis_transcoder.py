"""What three.js makes of a KTX2 file: Basis Universal's transcoder, as three.js brings it, in Node.

Nothing of it is ours: `tests.benchmarks.browser.three_folder` fetches it from npm. What it makes is
shown by Pillow (BC1, BC7), and ETC1 by a plain reader here.

Source of ETC1: Khronos Data Format Specification 1.4, chapter 21.
"""

from __future__ import annotations

import io
import json
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.benchmarks.browser import three_folder
from tests.node import told_by_node

Bytes = NDArray[np.uint8]

ETC1, BC1, BC7, RGBA = 0, 2, 6, 13
"""Numbers of Basis Universal's transcoder_texture_format."""
_DXGI = {BC1: 71, BC7: 98}
_ETC1_STEPS = np.array(
    [(2, 8), (5, 17), (9, 29), (13, 42), (18, 60), (24, 80), (33, 106), (47, 183)]
)
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
        given = str(folder), str(out / "file.ktx2"), temporary, json.dumps(formats)
        facts: dict[str, Any] = told_by_node(_PROGRAM, *given, timeout_s=120)
        made = {
            (form, level): (out / f"{form}-{level}").read_bytes()
            for form in formats
            for level in range(facts.get("levels", 0))
        }
    return facts, made


def shown(form: int, data: bytes, width: int, height: int) -> Bytes:
    """RGB [H, W, 3] of what was made of a picture whose sides are multiples of 4."""
    if form == RGBA:
        return np.frombuffer(data, np.uint8).reshape(height, width, 4)[:, :, :3]
    if form == ETC1:
        return _of_etc1(np.frombuffer(data, np.uint8).reshape(-1, 8), width, height)
    flags = (0x1 | 0x2 | 0x4 | 0x1000 | 0x80000, height, width, len(data), 0, 1)
    head = b"DDS " + struct.pack("<7I44x", 124, *flags)
    head += struct.pack("<2I4s5I", 32, 4, b"DX10", 0, 0, 0, 0, 0)
    head += struct.pack("<5I", 0x1000, 0, 0, 0, 0) + struct.pack("<5I", _DXGI[form], 3, 0, 1, 0)
    with Image.open(io.BytesIO(head + data)) as opened:
        return np.asarray(opened.convert("RGB"))


def _of_etc1(blocks: Bytes, width: int, height: int) -> Bytes:
    """Raises AssertionError for a second colour out of range, which ETC1 forbids."""
    flags = blocks[:, 3].astype(int)
    flip, is_difference = flags & 1, (flags & 2)[:, None] > 0
    bits = blocks[:, :3].astype(int)
    difference = ((bits & 7) + 4) % 8 - 4
    second = (bits >> 3) + difference
    assert not (is_difference & ((second < 0) | (second > 31))).any()
    wide = [(five << 3) | (five >> 2) for five in (bits >> 3, second)]
    first, second = (
        np.where(is_difference, five, 17 * four)
        for five, four in zip(wide, (bits >> 4, bits & 15), strict=True)
    )
    high, low = blocks[:, 4:].astype(int).reshape(-1, 2, 2).swapaxes(0, 1) @ [256, 1]
    pixels = np.empty((len(blocks), 4, 4, 3), int)
    for row in range(4):
        for column in range(4):
            bit = 4 * column + row
            in_second = np.where(flip == 1, row > 1, column > 1)
            steps = _ETC1_STEPS[np.where(in_second, flags >> 2 & 7, flags >> 5)]
            step = np.where(low >> bit & 1, steps[:, 1], steps[:, 0])
            step = np.where(high >> bit & 1, -step, step)
            pixels[:, row, column] = np.where(in_second[:, None], second, first) + step[:, None]
    whole = np.clip(pixels, 0, 255).astype(np.uint8).reshape(height // 4, width // 4, 4, 4, 3)
    return whole.swapaxes(1, 2).reshape(height, width, 3)
