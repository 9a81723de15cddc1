"""A program that runs beside the bench, and the blocks of numbers that go both ways: a line `NAME
COUNT`, a line of numbers, and the line `end` where one side has said all."""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from subprocess import DEVNULL, PIPE

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array

_BEGIN_S = 20.0
"""The first answer may take this long: some languages compile when they start."""
_LONGEST = 1 << 26
"""Bytes of the longest line: a covariance of a thousand parameters has a third of that."""
MOST = 2_500_000
"""Numbers of the longest block, of up to 25 letters each."""
_AT_ONCE = 1 << 16
"""Numbers that are words at the same time."""
_PAUSE_S = 5e-5
"""Between two looks at whether a program has read on."""
_QUOTED = 4
"""Last lines of a program that ended: R and Octave say why before the very last one."""
_SPELT = {"nan": "NaN", "inf": "Inf", "-inf": "-Inf"}
"""R reads no others."""
_MARK = "IPE_BENCH_PROGRAM"
_END_MARKED = (
    'for p in $(grep -lsF "$1" /proc/[0-9]*/environ); do p=${p#/proc/}; kill -9 "${p%/environ}";'
    " done"
)
_END_ALL = f"{_END_MARKED}; {_END_MARKED}"
"""Ends what has the mark in its environment, and what that has started in the meantime."""


class ProgramError(Exception):
    """Says what a program did wrong, in words that follow its name."""


def written(blocks: Mapping[str, Array]) -> str:
    """Writes blocks as text."""
    return "".join(
        f"{name} {values.size}\n{_line(values.ravel())}\n" for name, values in blocks.items()
    )


def _line(values: Array) -> str:
    parts = []
    for start in range(0, len(values), _AT_ONCE):
        words = map(repr, values[start : start + _AT_ONCE].tolist())
        parts.append(" ".join(_SPELT.get(word, word) for word in words))
    return " ".join(parts)


class Program:
    """Holds a running program.

    Its process group begins with a shell that waits for the end of this process, and then ends the
    group: with the program goes what it has started, however this process ends. On Linux this holds
    for other groups and sessions too: all that it starts inherits a mark in the environment. POSIX
    only.
    """

    def __init__(self, command: Sequence[str], folder: str, opening: str) -> None:
        self.opening, self.said, self.complaint, self.deadline = opening, bytearray(), b"", 0.0
        self.begun = ""
        """What the program has been sent of the next question."""
        token = secrets.token_hex(16)
        self.mark = f"{_MARK}={token}"
        shell = ("sh", "-c", f"read _; {_END_ALL}; kill -9 0", "sh", self.mark)
        self.guard = subprocess.Popen(
            shell, stdin=PIPE, stdout=DEVNULL, stderr=DEVNULL, process_group=0
        )
        group = self.guard.pid
        try:
            self.process = subprocess.Popen(
                command,
                cwd=folder,
                env=os.environ | {_MARK: token},
                stdin=PIPE,
                stdout=PIPE,
                stderr=PIPE,
                bufsize=0,
                process_group=group,
            )
        except OSError as error:
            self.guard.communicate()
            raise UserError(
                f"command={list(command)}: cannot be started ({error.strerror})"
            ) from None
        streams = (self.process.stdin, self.process.stdout, self.process.stderr)
        self.into, self.out, self.errors = (
            stream.fileno() for stream in streams if stream is not None
        )
        self.listening = [self.out, self.errors]
        for pipe in (self.into, self.errors):
            os.set_blocking(pipe, False)

    def ask(
        self, text: str, replies: Mapping[str, Callable[[Array], str]], seconds: float
    ) -> dict[str, Array]:
        """Sends a text, and returns the blocks up to `end`; those named in `replies` are questions,
        answered at once. The first line of the text is that of the next one too.

        Raises:
            ProgramError: the program ended, took longer than these seconds, or wrote something
                else.
        """
        begins, found = bool(self.opening), dict[str, Array]()
        self.deadline = time.monotonic() + (max(seconds, _BEGIN_S) if begins else seconds)
        self.require_silence(0.0)
        # Octave reads a line only if a character follows.
        self.send(f"{self.opening}{text.removeprefix(self.begun)}\n")
        while (block := self.block()) is not None:
            name, values = block
            if name in found:
                raise ProgramError(f"wrote {name} twice in one answer")
            if name not in replies:
                found[name] = values
                continue
            asked = time.monotonic()
            reply = replies[name](values)
            self.deadline += time.monotonic() - asked  # the bench's own time is not the program's
            self.send(f"{reply}\n")
        if begins:  # one that always says more than it should is found out before any work
            self.require_silence(0.05)
        self.opening = ""
        self.begun = text[: text.index("\n") + 1]
        self.deadline = time.monotonic() + seconds
        self.require_end()
        return found

    def require_end(self) -> None:
        """Waits until the program reads the first line of the next question: it does so once it has
        written all of this answer. What comes after `end` until then would be taken for the next
        answer."""
        self.send(self.begun)
        pause = 0.0
        while _unread(self.into) and not self.said.strip():
            if time.monotonic() > self.deadline:
                raise ProgramError("answered, and did not read on within the time limit")
            self.wait(pause)
            pause = _PAUSE_S
        self.require_silence(0.0)

    def require_silence(self, seconds: float) -> None:
        """Refuses what is written before it is asked for, but for empty lines."""
        if self.out in self.listening and select.select([self.out], [], [], seconds)[0]:
            self.said += os.read(self.out, 1 << 16)
        if self.said.strip():
            raise ProgramError(f"wrote {_shown(self.said.strip().splitlines()[0])} after `end`")
        self.said.clear()

    def send(self, text: str) -> None:
        data = memoryview(text.encode())
        while data:
            data = data[self.wait(0.1, data) :]

    def wait(self, seconds: float, data: memoryview | None = None) -> int:
        """Waits for the program, takes what it has written, and returns how much of the data it has
        read."""
        if (left := self.deadline - time.monotonic()) <= 0:
            hint = "" if self.said or data else "; does it flush its output after `end`?"
            raise ProgramError(f"gave no whole answer within the time limit{hint}")
        ready, free, _ = select.select(
            self.listening, [self.into] if data else [], [], min(left, seconds)
        )
        for pipe in ready:
            if not (chunk := os.read(pipe, 1 << 16)):
                self.listening.remove(pipe)
            elif pipe == self.out:
                self.said += chunk
            else:
                self.complaint = (self.complaint + chunk)[-4096:]
        try:
            if self.out in self.listening and (ready or self.process.poll() is None):
                return os.write(self.into, data) if data and free else 0
        except BrokenPipeError:
            pass
        raise ProgramError(self.ended())

    def line(self) -> bytes:
        start = 0
        while (stop := self.said.find(b"\n", start)) < 0:
            if (start := len(self.said)) > _LONGEST:
                raise ProgramError(f"wrote a line of more than {_LONGEST} letters")
            self.wait(0.1)
        text = bytes(self.said[:stop]).strip()
        del self.said[: stop + 1]
        return text

    def block(self) -> tuple[str, Array] | None:
        """Reads the next block; None at the end of an answer."""
        if (text := self.line()) == b"end":
            return None
        name, count, *more = [*text.decode("ascii", "replace").split(), "", ""]
        if not (name.isidentifier() and name.isascii() and count.isdigit()) or any(more):
            raise ProgramError(f"wrote {_shown(text)}, where a line NAME COUNT or `end` belongs")
        if len(count) > len(str(MOST)) or int(count) > MOST:
            raise ProgramError(
                f"wrote {name} with {count[:20]} numbers; a block has at most {MOST}"
            )
        # More words than numbers are not worth their memory.
        words = self.line().split(maxsplit=int(count))
        try:
            if wrong := next((word for word in words if b"_" in word), None):
                raise ValueError(f"could not convert string to float: {wrong[:80]}")
            values = np.array(words, dtype=float)
        except ValueError as error:
            raise ProgramError(f"wrote {name} with what is no number: {error}") from None
        if str(len(values)) != count:
            raise ProgramError(f"wrote {name} with {len(values)} numbers, and not {count[:20]}")
        return name, values

    def ended(self) -> str:
        """Says how the program ended, with its last line of standard error."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)
        with contextlib.suppress(BlockingIOError):
            self.complaint += os.read(self.errors, 1 << 16)
        code, last = self.process.returncode, self.complaint.strip().splitlines()[-_QUOTED:]
        how = "closed its output" if code is None else f"ended with exit code {code}"
        how = f"was ended by signal {-code}" if code is not None and code < 0 else how
        return how + (": " + " | ".join(_shown(line)[1:-1] for line in last) if last else "")

    def end(self) -> None:
        """Ends the program with all that it has started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.guard.pid, signal.SIGKILL)
        self.process.kill()
        subprocess.run(
            ("sh", "-c", _END_ALL, "sh", self.mark),
            stdin=DEVNULL,
            stdout=DEVNULL,
            stderr=DEVNULL,
            check=False,
        )
        for process in (self.guard, self.process):
            process.wait()
            for stream in filter(None, (process.stdin, process.stdout, process.stderr)):
                stream.close()


def _unread(pipe: int) -> int:
    """Returns how many bytes wait in a pipe, as its writer; 0 where the system does not tell."""
    with contextlib.suppress(OSError):
        return struct.unpack("i", fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)))[0]
    return 0


def _shown(text: bytes | bytearray) -> str:
    return repr(text.decode(errors="replace").strip()[:80])
