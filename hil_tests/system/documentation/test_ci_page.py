"""The YAML of `docs/ci.md` can be read, and its commands have only options that exist."""

import re
from collections.abc import Iterator
from typing import Any

import pytest

from hil_tests.paths import REPOSITORY
from hil_tests.system.documentation.markdown_blocks import Block, Prompt, blocks_of
from hil_tests.system.documentation.test_pages import check_words

yaml = pytest.importorskip("yaml")
PAGE = REPOSITORY / "docs" / "ci.md"
BLOCKS = [block for block in blocks_of(PAGE) if block.language == "yaml"] if PAGE.exists() else []

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PAGE.exists(), reason="documents are in the source tree"),
]


def commands_in(node: Any) -> Iterator[str]:  # noqa: ANN401 - whatever YAML holds
    """Yield the command lines of GitHub's steps and of GitLab's scripts."""
    if isinstance(node, list):
        for value in node:
            yield from commands_in(value)
    elif isinstance(node, dict):
        for key, value in node.items():
            if key in {"run", "script", "after_script"}:
                for text in [value] if isinstance(value, str) else value:
                    yield from text.splitlines()
            else:
                yield from commands_in(value)


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_its_commands_have_only_options_that_exist(block: Block) -> None:
    found = yaml.safe_load(block.text)
    commands = list(commands_in(found))
    assert bool(commands) == ("exporter.yaml" not in block.text)
    for command in commands:
        check_words(Prompt(command=command.replace(".venv/bin/", ""), shown=""))
    if commands:
        assert any(re.search(r"\bpytest .*--radar", command) for command in commands)
        assert "hil-artifacts/" in block.text


def test_an_option_that_does_not_exist_is_found() -> None:
    with pytest.raises(AssertionError):
        check_words(Prompt(command="pytest tests --radar emu --hil-stric", shown=""))
