"""Weight files: checked before they are read, downloaded within bounds, kept under their sha256."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import safetensors.torch
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging import weight_files
from pipelines.nerf.judging.weight_files import read_weights


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    safetensors.torch.save_file({"a.weight": torch.arange(1000.0)}, path)
    return path


@pytest.mark.parametrize("zipped", [True, False])
def test_both_kinds_of_pytorch_file_are_read(tmp_path: Path, zipped: bool) -> None:
    path = tmp_path / "w.pth"
    torch.save({"a": torch.eye(3)}, path, _use_new_zipfile_serialization=zipped)
    found = read_weights(str(path), sha256(path).upper(), tmp_path)
    assert list(found) == ["a"]
    assert torch.equal(found["a"], torch.eye(3))
    assert [item.name for item in tmp_path.iterdir()] == ["w.pth"], "local files are not copied"


def test_file_with_another_sha256_is_refused_unread(tmp_path: Path, weights: Path) -> None:
    with pytest.raises(NerfError, match="is not the file that was configured") as caught:
        read_weights(str(weights), "0" * 64, tmp_path)
    assert caught.value.code == "lpips_weights"
    assert str(weights.parent) not in str(caught.value)
    assert sha256(weights) in caught.value.message
    with pytest.raises(NerfError, match="64 hexadecimal digits"):
        read_weights(str(weights), "abc", tmp_path)


class Bomb:
    """Unpickled without care, it would write a file."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (self.target,)  # type: ignore[return-value]


def test_files_that_hold_something_else_are_refused_and_run_nothing(
    tmp_path: Path, weights: Path
) -> None:
    cut, bomb, odd = tmp_path / "cut.safetensors", tmp_path / "bomb.pth", tmp_path / "odd.pth"
    cut.write_bytes(weights.read_bytes()[:500])
    torch.save({"features.0.weight": Bomb(tmp_path / "ran")}, bomb)
    torch.save({"features.0.weight": 3}, odd)
    text = tmp_path / "page.html"
    text.write_text("<html>not found</html>")
    for path in (cut, bomb, text):
        with pytest.raises(NerfError, match="neither a safetensors file nor") as caught:
            read_weights(str(path), sha256(path), tmp_path)
        assert caught.value.code == "lpips_weights"
    assert not (tmp_path / "ran").exists()
    with pytest.raises(NerfError, match="something else than named tensors"):
        read_weights(str(odd), sha256(odd), tmp_path)
    with pytest.raises(NerfError, match=r"nowhere\.pth cannot be read: No such file"):
        read_weights(str(tmp_path / "nowhere.pth"), "0" * 64, tmp_path)


@dataclass
class Site:
    """A server of some files; it counts what is asked of it."""

    url: str
    files: dict[str, bytes] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)


@pytest.fixture
def site() -> Iterator[Site]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.split("?")[0]
            served.asked.append(path)
            content = served.files.get(path)
            if path == "/moved":
                self.send_response(302)
                self.send_header("Location", served.files["/moved"].decode())
                self.end_headers()
            elif content is None:
                self.send_error(404)
            else:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    served = Site(f"http://127.0.0.1:{server.server_address[1]}")
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield served
    server.shutdown()
    server.server_close()
    thread.join()


def test_download_is_kept_under_its_sha256(site: Site, weights: Path, tmp_path: Path) -> None:
    site.files["/w"] = weights.read_bytes()
    cache = tmp_path / "a" / "cache"
    for _ in range(2):
        found = read_weights(f"{site.url}/w", sha256(weights), cache)
        assert torch.equal(found["a.weight"], torch.arange(1000.0))
    assert site.asked == ["/w"]
    assert [path.name for path in cache.iterdir()] == [f"{sha256(weights)}.weights"]


def test_damaged_copy_in_the_cache_is_replaced(site: Site, weights: Path, tmp_path: Path) -> None:
    site.files["/w"] = weights.read_bytes()
    kept = tmp_path / f"{sha256(weights)}.weights"
    kept.write_bytes(weights.read_bytes()[:-1] + b"?")
    read_weights(f"{site.url}/w", sha256(weights), tmp_path)
    assert site.asked == ["/w"]
    assert sha256(kept) == sha256(weights)


def test_download_of_something_else_leaves_nothing_behind(
    site: Site, weights: Path, tmp_path: Path
) -> None:
    site.files["/w"] = weights.read_bytes()[:-1]
    for path, message in (("/w", "its sha256 is"), ("/none", "the server answers 404")):
        url = f"{site.url}{path}?token=secret"
        with pytest.raises(NerfError, match=message) as caught:
            read_weights(url, sha256(weights), tmp_path)
        assert caught.value.code == "lpips_weights"
        assert "secret" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_download_follows_no_redirect_to_a_local_file(
    site: Site, weights: Path, tmp_path: Path
) -> None:
    site.files["/moved"] = weights.as_uri().encode()
    with pytest.raises(NerfError, match="cannot be downloaded"):
        read_weights(f"{site.url}/moved", sha256(weights), tmp_path)
    site.files |= {"/moved": f"{site.url}/w".encode(), "/w": weights.read_bytes()}
    read_weights(f"{site.url}/moved", sha256(weights), tmp_path)
    assert site.asked == ["/moved", "/moved", "/w"]


def test_download_that_is_too_large_or_has_no_server_is_refused(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weight_files, "MAX_FILE_BYTES", 1 << 20)
    site.files["/w"] = bytes((1 << 20) + 1)
    with pytest.raises(NerfError, match="larger than 1 MiB"):
        read_weights(f"{site.url}/w", "0" * 64, tmp_path)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(NerfError, match="Connection refused"):
        read_weights("http://127.0.0.1:9/w", "0" * 64, tmp_path)
