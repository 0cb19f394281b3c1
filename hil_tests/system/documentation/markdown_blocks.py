"""Fenced blocks of a document, and the commands in them."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

_BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>.+?) -->\n+)?(?P<indent> *)```(?P<language>[\w-]*).*\n"
    r"(?P<text>(?:.*\n)*?)(?P=indent)```$",
    re.MULTILINE,
)
_NEXT_COMMAND = {"|", "||", "&&", ";", "&"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A fenced block.

    Attributes
    ----------
    line
        Of the document, where the text begins.
    not_run
        Why it is not run, as the comment before it says; "" if it is.
    """

    page: Path
    line: int
    language: str
    text: str
    not_run: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Prompt:
    """A command line of a console block, and what the block shows below it."""

    command: str
    shown: str

    def programs(self) -> list[list[str]]:
        """Words of each program that the line starts, without redirections."""
        lexer = shlex.shlex(self.command, posix=True, punctuation_chars=True)
        lexer.whitespace_split, lexer.commenters = True, "#"
        programs: list[list[str]] = [[]]
        words = iter(lexer)
        for word in words:
            if word in _NEXT_COMMAND:
                programs.append([])
            elif word in {"<", ">", ">>"}:
                next(words)
            else:
                programs[-1].append(word)
        return [program for program in programs if program]


def blocks_of(page: Path) -> list[Block]:
    """Return the fenced blocks of a document in order."""
    text = page.read_text("utf-8")
    return [
        Block(
            page=page,
            line=text.count("\n", 0, found.start("text")) + 1,
            language=found["language"],
            text=re.sub(rf"^{found['indent']}", "", found["text"], flags=re.MULTILINE),
            not_run=found["reason"] or "",
        )
        for found in _BLOCK.finditer(text)
    ]


def prompts_of(block: Block) -> list[Prompt]:
    """Return the commands of a console block; a backslash at its end continues a line."""
    head, *parts = re.split(r"^\$ ", block.text.replace("\\\n", " "), flags=re.MULTILINE)
    assert not head.strip(), f"{block}: output before the first command"
    lines = [part.partition("\n") for part in parts]
    return [Prompt(command=command, shown=shown) for command, _, shown in lines]
