"""Open input files, which are not trusted: regular ones only, without blocking, and no longer than a limit."""

from __future__ import annotations

import errno
import os
import stat
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import BinaryIO

MAX_WHOLE_BYTES = 1 << 31
"""The longest file that is read whole: 2 GiB of text are 20 million edges, or a model of 10,000 images."""
_LFS_HEAD, _LFS_BYTES = b"version https://git-lfs", 1024
"""How a pointer of Git LFS, in the place of the file itself, begins, and a length that it stays below."""
_COMPRESSED = {b"\x1f\x8b\x08": "gzip", b"\x28\xb5\x2f\xfd": "zstd", b"\xfd7zXZ\0": "xz"}
_COMPRESSED |= {b"BZh%d1AY&SY" % level: "bzip2" for level in range(1, 10)}
"""How what a compressor writes begins; no format that is read begins so, whatever the file is called."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_KINDS = {
    stat.S_IFDIR: (errno.EISDIR, "a folder"),
    stat.S_IFIFO: (errno.EINVAL, "a pipe"),
    stat.S_IFSOCK: (errno.EINVAL, "a socket"),
    stat.S_IFCHR: (errno.EINVAL, "a device"),
    stat.S_IFBLK: (errno.EINVAL, "a device"),
}


def open_input(path: Path) -> BinaryIO:
    """The file, open for reading bytes.

    Raises `OSError` for one that is missing, not regular, compressed, or a pointer of Git LFS.
    A pipe would wait for a writer and a device never end, so the kind of file is checked before opening, and after.
    """
    try:
        _check_regular(path, os.stat(path).st_mode)
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    except ValueError as error:  # a zero byte in the name
        raise OSError(errno.EINVAL, "no name of a file", str(path)) from error
    try:
        status = os.fstat(handle)
        _check_regular(path, status.st_mode)
        begins = os.pread(handle, len(_LFS_HEAD), 0)
        for magic, compressor in _COMPRESSED.items():
            if begins.startswith(magic):
                raise OSError(errno.ENODATA, f"is compressed by {compressor}: unpack it first", str(path))
        if status.st_size < _LFS_BYTES and begins == _LFS_HEAD:
            raise OSError(errno.ENODATA, "is a pointer of Git LFS, not the file itself: run git lfs pull", str(path))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_input(path: Path, limit: int = MAX_WHOLE_BYTES) -> bytes:
    """All bytes of the file. Raises `OSError` as `open_input` does, and for more bytes than the limit."""
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"holds {size} bytes, the limit is {limit}", str(path))
        return file.read(size)


def read_input_text(path: Path, limit: int = MAX_WHOLE_BYTES, *, errors: str = "strict") -> str:
    """The text of a UTF-8 file, with or without a byte-order mark, its line ends as one newline each.

    Raises `OSError` as `read_input` does and for UTF-16, `UnicodeDecodeError` unless `errors` is another way to treat
    wrong bytes.
    """
    contents = read_input(path, limit)
    if contents.startswith(_UTF_16):
        raise OSError(errno.EILSEQ, "is text in UTF-16, as PowerShell writes it: save it as UTF-8", str(path))
    return TextIOWrapper(BytesIO(contents), encoding="utf-8-sig", errors=errors).read()


def beginning(path: Path, size: int) -> bytes:
    """The first bytes of a file, by which readers recognise formats; none where it cannot be read."""
    try:
        with open_input(path) as file:
            return file.read(size)
    except OSError:
        return b""


def _check_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        number, kind = _KINDS.get(stat.S_IFMT(mode), (errno.EINVAL, "something else"))
        raise OSError(number, f"is {kind}, no file", str(path))
