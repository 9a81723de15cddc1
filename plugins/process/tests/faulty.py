"""A program that answers with the first readings, except where the first one is 99: there it has
the fault that its argument names. Faults in capitals show in every trial. Spaces are as R's `cat`
leaves them."""

import os
import signal
import sys
import time

RIGHT = "x  4 \n{} \nstatus 1\n0\niterations 1\n1\nsimulations 1\n1\njacobians 1\n1\nend\n"


def say(text: str) -> None:
    sys.stdout.buffer.write(text.encode())
    sys.stdout.flush()


def forever(write) -> None:
    while True:
        write()


def die(message: str, code: int) -> None:
    sys.stderr.write(f"reading settings\n{message}\n")
    sys.stderr.flush()
    os._exit(code)


def fork(then) -> None:
    if os.fork() == 0:
        time.sleep(1000)
    then()


def flee(then) -> None:
    """Leaves a child in a session of its own, without a parent."""
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            time.sleep(1000)
        os._exit(0)
    then()


def answer_with(P: str) -> str:
    return f"x 4\n1 2 3 4\nP 16\n{P}\nstatus 1\n0\nend\n"


WRONG = {
    "short": "x 4\n1 2\nstatus 1\n0\nend\n",
    "word": "x 4\n1 2 3 four\nstatus 1\n0\nend\n",
    "huge": "x 99999999999\n1 2\nend\n",
    "print": "Warning: step rejected\n",
    "nothing": "end\n",
    "no_status": "x 4\n1 2 3 4\nend\n",
    "status": "x 4\n1 2 3 4\nstatus 1\n42\nend\n",
    "half_status": "x 4\n1 2 3 4\nstatus 1\n0.5\nend\n",
    "twice": "x 4\n1 2 3 4\nx 4\n1 2 3 4\nstatus 1\n0\nend\n",
    "count": "x 4\n1 2 3 4\nstatus 1\n0\niterations 1\n-1\nend\n",
    "skew": answer_with(" ".join(map(str, range(16)))),
    "negative": answer_with("-1 0 0 0 0 -1 0 0 0 0 -1 0 0 0 0 -1"),
    "indefinite": answer_with("1 2 0 0 2 1 0 0 0 0 1 0 0 0 0 1"),
    "no_variance": answer_with("0 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
    "infinite": answer_with("inf 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
    "underscore": "x 4\n1_0 1_0 1_0 1_0\nstatus 1\n0\nend\n",
    "hexadecimal": "x 4\n0x10 0 0 0\nstatus 1\n0\nend\n",
    "digits": "x 4\n\u0661 0 0 0\nstatus 1\n0\nend\n",
    "question": "simulate 3\n1 2 3\n",
    "crowd": "simulate 400000\n" + "0 " * 400000 + "\n",
    "flood": "simulate 3000000\n",
    "nan": "x 4\nnan NaN inf 1\nstatus 1\n0\nend\n",
}
DONE = {
    "signal": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "exit": lambda: die("matrix is singular", 2),
    "sleep": lambda: time.sleep(1000),
    "blocks": lambda: forever(lambda: say("a 1\n1\nsimulate 4\n0 0 0 0\n")),
    "line": lambda: forever(lambda: say("1 " * 5000)),
    "stderr": lambda: forever(lambda: os.write(2, b"oh\n" * 5000)),
    "close": lambda: (sys.stdout.flush(), os.close(1), time.sleep(1000)),
    "fork": lambda: fork(lambda: None),
    "fork_and_exit": lambda: fork(lambda: os._exit(0)),
    "flee": lambda: flee(lambda: None),
    "flee_and_exit": lambda: flee(lambda: os._exit(0)),
}


def main(fault: str) -> None:
    if sys.stdin.readline().split()[:2] != ["ipe-bench", "2" if fault == "VERSION" else "1"]:
        die("speaks version 2 alone", 3)
    if fault == "LICENCE":
        die("the licence has expired", 3)
    if fault == "BANNER":
        say("Solver 3.1, 2026\n")
    while line := sys.stdin.readline():
        if line.split()[:1] != ["z"]:
            continue
        z = sys.stdin.readline().split()
        bad = float(z[0]) == 99.0
        if bad and fault in DONE:
            DONE[fault]()
        answer = RIGHT.format(" ".join(z[:4]))
        say(
            WRONG[fault]
            if bad and fault in WRONG
            else answer * (2 if fault == "DOUBLE" or (bad and fault == "more") else 1)
        )
        if bad and fault == "blank":
            say("\n \n")
        if bad and fault in ("late", "blank_and_late"):
            say("\n" if fault == "blank_and_late" else "")
            time.sleep(0.2)
            say(RIGHT.format("0 0 0 0"))
        if fault == "ONCE":
            return


main(sys.argv[1])
