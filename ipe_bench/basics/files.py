"""Writes files that appear under their name complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import getpass
import hashlib
import json
import os
import socket
import stat
import tempfile
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.visible import visible


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Calls `write(temporary path)` in the same folder and renames the result: readers see all of
    it or nothing.

    Raises:
        StorageError: the disk is full, or the folder cannot be written to any more.
    """
    writer = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    temporary = path.with_name(f".{path.name}.{writer}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror if error.errno is None else os.strerror(error.errno)
        raise StorageError(
            f"{path.parent}: cannot be written to any more ({reason or error}); earlier results are"
            " intact; run the same command again"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def regular(path: Path) -> Path:
    """Returns the path of a regular file; a pipe or a device may be endless.

    Raises:
        OSError: something else is there, or nothing (FileNotFoundError).
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "is no regular file")
    return path


def fault_of(path: Path) -> str:
    """Says why a path is no file that can be read; empty if it is one."""
    if path.is_file():
        return ""
    kind = "is a folder" if path.is_dir() else "is no regular file"
    return f"{kind}; name a file" if os.path.lexists(path) else "there is no such file"


def make_folder(path: Path) -> None:
    """Makes sure that there is such a folder.

    Raises:
        StorageError: there is none and none can be made, as where a file has its name.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be made a folder ({error.strerror or error}); move what is there"
        ) from None


def write_text(path: Path, text: str) -> None:
    """Writes a text file in one piece, without control characters and with the bytes of names that
    are no UTF-8 written out; see `write_atomically`."""
    content = visible(text).encode("utf-8", "backslashreplace")
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file in one piece; see `write_atomically`."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def cache_folder() -> Path:
    """Returns the folder of compiled files: `IPE_BENCH_CACHE`, or the user's cache; if that cannot
    be written to, a folder of the user's own among temporary files."""
    for place in (_chosen_cache, _spare_cache):
        with contextlib.suppress(
            OSError, KeyError, RuntimeError
        ):  # of homes that are not known, too
            folder = place()
            with tempfile.TemporaryFile(dir=folder):
                return folder
    return Path(os.devnull)  # below which nothing can be kept


def kept(made_of: str, suffix: str, make: Callable[[], bytes]) -> bytes:
    """Returns the content that a text identifies, made once per machine and kept in the cache.

    A kept file is used only if it was made of this text, is whole, and belongs to this user or the
    system.
    """
    # It begins with the digests of what it was made of and of its content; others are made anew.
    of = hashlib.sha256(made_of.encode()).digest()
    path = cache_folder() / f"{of.hex()[:32]}{suffix}"
    stored = _own_bytes(path)
    content = stored[2 * len(of) :]
    if stored[: 2 * len(of)] != of + hashlib.sha256(content).digest():
        content = make()
        stored = of + hashlib.sha256(content).digest() + content
        with contextlib.suppress(StorageError):
            write_atomically(
                path, lambda temporary: (temporary.write_bytes(stored), temporary.chmod(0o600))
            )
    return content


def _own_bytes(path: Path) -> bytes:
    """Reads a file that belongs to this user or the system and is writable by no other user;
    returns b"" otherwise."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        about = os.fstat(file.fileno())
        foreign = os.name == "posix" and (
            about.st_uid not in (0, os.geteuid()) or about.st_mode & 0o022
        )
        return b"" if foreign else file.read()


def _chosen_cache() -> Path:
    chosen = os.environ.get("IPE_BENCH_CACHE")
    home = "~" if os.environ.get("HOME", "~") else f"~{getpass.getuser()}"
    caches = os.environ.get("XDG_CACHE_HOME") or f"{home}/.cache"
    folder = Path(chosen or Path(caches) / "ipe-bench").expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _spare_cache() -> Path:
    """Returns a folder that belongs to this user alone, whoever may write to the folder of
    temporary files."""
    owner = os.geteuid() if os.name == "posix" else "cache"
    folder = Path(tempfile.gettempdir()) / f"ipe-bench-{owner}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if os.name == "posix":
        about = folder.lstat()
        open_to_others = about.st_uid != owner or about.st_mode & 0o77
        if open_to_others or not stat.S_ISDIR(about.st_mode):
            raise OSError(errno.EPERM, "belongs to others")
    return folder


def own_conf() -> Path:
    """Returns the folder of our configs: inside the installed package, or beside it in a
    checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise FileNotFoundError(
        "the configs of ipe-bench are neither in the package nor beside it; install it again"
    )
