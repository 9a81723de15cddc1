"""A program that runs beside the bench, and the blocks of numbers that go both ways: a line `NAME COUNT`, a line of
numbers, and the line `end` where one side has said all."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
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
_QUOTED = 4
"""Last lines of a program that ended: R and Octave say why before the very last one."""
_SPELT = {"nan": "NaN", "inf": "Inf", "-inf": "-Inf"}
"""R reads no others."""


class ProgramError(Exception):
    """Says what a program did wrong, in words that follow its name."""


def written(blocks: Mapping[str, Array]) -> str:
    """Writes blocks as text."""
    words = {name: [_SPELT.get(word, word) for word in map(repr, v.ravel().tolist())] for name, v in blocks.items()}
    return "".join(f"{name} {len(each)}\n{' '.join(each)}\n" for name, each in words.items())


class Program:
    """Holds a running program.

    Its process group begins with a shell that waits for the end of this process, and then ends the group: with the
    program goes what it has started, however this process ends. POSIX only.
    """

    def __init__(self, command: Sequence[str], folder: str, opening: str) -> None:
        self.opening, self.said, self.complaint, self.deadline = opening, bytearray(), b"", 0.0
        shell = ("sh", "-c", "read _; kill -9 0")
        self.guard = subprocess.Popen(shell, stdin=PIPE, stdout=DEVNULL, stderr=DEVNULL, process_group=0)
        group = self.guard.pid
        try:
            self.process = subprocess.Popen(
                command, cwd=folder, stdin=PIPE, stdout=PIPE, stderr=PIPE, bufsize=0, process_group=group
            )
        except OSError as error:
            self.guard.communicate()
            raise UserError(f"command={list(command)}: cannot be started ({error.strerror})") from None
        streams = (self.process.stdin, self.process.stdout, self.process.stderr)
        self.into, self.out, self.errors = (stream.fileno() for stream in streams if stream is not None)
        self.listening = [self.out, self.errors]
        for pipe in (self.into, self.errors):
            os.set_blocking(pipe, False)

    def ask(self, text: str, replies: Mapping[str, Callable[[Array], str]], seconds: float) -> dict[str, Array]:
        """Sends a text, and returns the blocks up to `end`; those named in `replies` are questions, answered at once.

        Raises:
            ProgramError: the program ended, took longer than these seconds, or wrote something else.
        """
        begins, found = bool(self.opening), dict[str, Array]()
        self.deadline = time.monotonic() + (max(seconds, _BEGIN_S) if begins else seconds)
        self.require_silence(0.0)
        self.send(self.opening + text)
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
            self.send(reply)
        if begins:  # one that always says more than it should is found out before any work
            self.require_silence(0.05)
        self.opening = ""
        return found

    def require_silence(self, seconds: float) -> None:
        """Refuses what is written before it is asked for, which would be taken for the next answer."""
        if self.out in self.listening and select.select([self.out], [], [], seconds)[0]:
            self.said += os.read(self.out, 1 << 16)
        if self.said.strip():
            raise ProgramError(f"wrote {_shown(self.said.strip().splitlines()[0])} after `end`")

    def send(self, text: str) -> None:
        data = memoryview(f"{text}\n".encode())  # Octave reads a line only if a character follows
        while data:
            data = data[self.wait(data) :]

    def wait(self, data: memoryview | None = None) -> int:
        """Waits for the program, takes what it has written, and returns how much of the data it has read."""
        if (left := self.deadline - time.monotonic()) <= 0:
            hint = "" if self.said or data else "; does it flush its output after `end`?"
            raise ProgramError(f"gave no whole answer within the time limit{hint}")
        ready, free, _ = select.select(self.listening, [self.into] if data else [], [], min(left, 0.1))
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
            self.wait()
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
        try:
            values = np.array(self.line().split(), dtype=float)
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
        """Ends the program with all that it has started in its process group."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.guard.pid, signal.SIGKILL)
        self.process.kill()
        for process in (self.guard, self.process):
            process.wait()
            for stream in filter(None, (process.stdin, process.stdout, process.stderr)):
                stream.close()


def _shown(text: bytes | bytearray) -> str:
    return repr(text.decode(errors="replace").strip()[:80])
