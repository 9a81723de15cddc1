"""`ipe-bench completion SHELL`: the script by which a shell completes our commands, and the answers that it asks for.

What may stand at the end of a line is left to `candidates`. Nothing here or there loads a library of numbers.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ipe_bench.basics.errors import UserError
from ipe_bench.cli.candidates import Candidate, candidates

_BASH = """\
# Completion of ipe-bench for bash; in ~/.bashrc: eval "$(ipe-bench completion bash)"
_ipe_bench() {
    local IFS=$'\\n'
    COMPREPLY=($(COMP_LINE="${COMP_LINE:0:COMP_POINT}" COMP_WORDBREAKS="$COMP_WORDBREAKS" \\
        "${1/#\\~/$HOME}" completion bash --query 2>/dev/null))
}
complete -o nospace -F _ipe_bench ipe-bench
"""
_ZSH = """\
#compdef ipe-bench
# Completion of ipe-bench for zsh; in ~/.zshrc, behind compinit: eval "$(ipe-bench completion zsh)"
_ipe_bench() {
    local line text
    local -a found whole part shown_whole shown_part
    line="${(j: :)words[1,CURRENT-1]} $PREFIX"
    found=("${(@f)$(COMP_LINE="$line" ${~words[1]} completion zsh --query 2>/dev/null)}")
    for line in $found; do
        text="${line%%$'\\t'*}"
        [[ -z "$text" ]] && continue
        if [[ "$text" == *' ' ]]; then
            whole+=("${text% }") shown_whole+=("${text% }  ${line#*$'\\t'}")
        else
            part+=("$text") shown_part+=("$text  ${line#*$'\\t'}")
        fi
    done
    compadd -l -d shown_whole -S ' ' -a whole
    compadd -l -d shown_part -S '' -a part
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _ipe_bench ipe-bench
"""
_FISH = """\
# Completion of ipe-bench for fish; in ~/.config/fish/config.fish: ipe-bench completion fish | source
function __ipe_bench
    set -lx COMP_LINE (commandline -cp)
    set -l words (commandline -opc)
    eval $words[1] completion fish --query 2>/dev/null
end
complete -c ipe-bench -f -a '(__ipe_bench)'
"""
_SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}
_WORD_BREAKS = " \t\n\"'@><=;|&(:"
"""Where bash begins a new word unless told otherwise."""


def main(shell: str, query: bool) -> int:
    """Prints the script, or answers what it asks."""
    if not query:
        print(_SCRIPTS[shell], end="")
        return 0
    if "COMP_LINE" not in os.environ:
        raise UserError("completion --query: is what a shell asks while completing, with COMP_LINE set")
    line = Line.of(os.environ["COMP_LINE"])
    write = _WRITERS[shell]
    for found in candidates(line.before, line.current):
        print(write(found, line))
    sys.stdout.flush()
    return 0


@dataclass(frozen=True)
class Line:
    """A command line up to the cursor, as a shell would read it."""

    before: Sequence[str]
    """The words behind the program's name that are complete."""
    current: str
    """The word that is being typed, without its quotes."""
    kept: str
    """What of that bash does not replace: up to an open quote, or to the last sign that ends a word for it."""
    quoted: bool
    """Whether a quote is open."""

    @classmethod
    def of(cls, text: str) -> Line:
        words: list[str] = []
        word, kept, quote, escaped = "", 0, "", False
        breaks = os.environ.get("COMP_WORDBREAKS", _WORD_BREAKS)
        for sign in text:
            if escaped:
                word, escaped = word + sign, False
            elif sign == "\\" and quote != "'":
                escaped = True
            elif quote:
                word, quote = (word, "") if sign == quote else (word + sign, quote)
            elif sign in "'\"":
                quote, kept = sign, len(word)
            elif sign.isspace():
                if word:
                    words.append(word)
                word, kept = "", 0
            else:
                word += sign
                kept = len(word) if sign in breaks else kept
        names = [i for i, name in enumerate(words) if Path(name).name.startswith("ipe-bench")]
        return cls(words[(names[-1] if names else 0) + 1 :], word, word[:kept], bool(quote))


def _for_bash(found: Candidate, line: Line) -> str:
    text = found.text[len(line.kept) :]
    if line.quoted:
        return text
    return re.sub(r"([\s\\'\"$&;|<>()*?#~`!])", r"\\\1", text) + (" " if found.whole else "")


def _for_zsh(found: Candidate, line: Line) -> str:
    return f"{found.text}{' ' if found.whole else ''}\t{found.meaning}"


def _for_fish(found: Candidate, line: Line) -> str:
    return f"{found.text}\t{found.meaning}"


_WRITERS: dict[str, Callable[[Candidate, Line], str]] = {"bash": _for_bash, "zsh": _for_zsh, "fish": _for_fish}
