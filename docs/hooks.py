"""Hooks of mkdocs and griffe for what the site shows and `docs/` does not hold as a page.

Pages link to files as they lie in the repository, so that they read as well there. A file outside
`docs/` that a page links to becomes a part of the site, under `repository/`. An example,
`docs/examples/NN_name.py`, becomes a page: its docstring, then its code. Links follow. A method
that a driver makes of a procedure is shown as it is called.
"""

import ast
import os
import re
from copy import copy
from pathlib import Path

from griffe import Expr, ExprSubscript, Extension, Function, Parameter, Parameters
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

DOCS = Path(__file__).parent
ROOT = DOCS.parent
EXAMPLES = sorted(DOCS.glob("examples/[0-9]*.py"))
_LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)[^)#\s]+")
_LOADED = re.compile(
    r"<(?:script|img|iframe|link rel=\"(?:stylesheet|preconnect)\")[^>]+=\"(?:https?:)?//[^>]*>"
)


def on_config(config: MkDocsConfig) -> None:
    """List the examples below their index."""
    for section in config.nav or []:
        for entries in section.values():
            for entry in entries if isinstance(entries, list) else []:
                if "Examples" in entry:
                    entry["Examples"] = ["examples/README.md", *map(_uri, EXAMPLES)]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the examples, and what pages link to outside `docs/`."""
    for example in EXAMPLES:
        files.append(File.generated(config, _uri(example), content=_example_page(example)))
    pages = [DOCS / file.src_uri for file in files.documentation_pages() if file.abs_src_path]
    for page in pages:
        for target in filter(None, (_target(page, link) for link in _links(page))):
            uri = _uri(target)
            if files.get_file_from_path(uri) is None:
                level = InclusionLevel.NOT_IN_NAV
                kept = File.generated(config, uri, abs_src_path=str(target), inclusion=level)
                files.append(kept)
                if target.suffix == ".md":
                    pages.append(target)  # whose links count, too


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Let links lead to where their files are on the site."""
    uri = page.file.src_uri
    file = ROOT / uri.removeprefix("repository/") if uri.startswith("repository/") else DOCS / uri

    def there(link: re.Match[str]) -> str:
        target = _target(file, link[0])
        return os.path.relpath(_uri(target), Path(uri).parent) if target else link[0]

    return _LINK.sub(there, markdown)


def on_page_content(html: str, **_: object) -> str:
    """Show the two colons that introduce code in a docstring as one."""
    return html.replace("::</p>", ":</p>")


def on_post_page(output: str, page: Page, **_: object) -> None:
    """Refuse a page that would load something from another host when it is shown."""
    if loaded := _LOADED.search(output):
        raise PluginError(f"{page.file.src_uri} loads from the internet: {loaded[0]}")


def _links(page: Path) -> list[str]:
    return _LINK.findall(page.read_text("utf-8"))


def _target(page: Path, link: str) -> Path | None:
    """Return the file of the repository that a link leads to, if it is one."""
    target = (page.parent / link).resolve()
    return target if target.is_file() and target.is_relative_to(ROOT) else None


def _uri(file: Path) -> str:
    """Return where a file of the repository is on the site."""
    if file in EXAMPLES:
        file = file.with_suffix(".md")
    if file.is_relative_to(DOCS):
        return file.relative_to(DOCS).as_posix()
    return f"repository/{file.relative_to(ROOT).as_posix()}"


def _example_page(file: Path) -> str:
    source = file.read_text("utf-8")
    module = ast.parse(source)
    title, _, text = (ast.get_docstring(module) or file.stem).partition("\n")
    docstring = module.body[0]
    code = "\n".join(source.splitlines()[docstring.end_lineno :]).strip()
    title = f"{file.stem[:2]}. {title.rstrip('.')}"
    return f"# {title}\n{text}\n\n`docs/examples/{file.name}`:\n\n```python\n{code}\n```\n"


class DriverMethods(Extension):
    """Show a procedure that a decorator of `driver.link` makes a method as it is called."""

    _DECORATORS = frozenset(
        f"xethru_protocol.driver.link.{name}" for name in ("receives", "sends", "sends_once")
    )

    def on_function(self, *, func: Function, **_: object) -> None:
        """Leave out the link, and return the result instead of the steps."""
        if not any(one.callable_path in self._DECORATORS for one in func.decorators):
            return
        _, *others = func.parameters
        func.parameters = Parameters(Parameter("self"), *others)
        if isinstance(func.returns, ExprSubscript):
            result = func.returns.slice
            func.returns = result if isinstance(result, Expr) else str(result)
        func.decorators = []
        if func.parent is not None and func.parent.name == "RadarState":  # both drivers have it
            awaited = copy(func)
            awaited.labels = {*func.labels, "async"}
            func.package["driver.async_radar.AsyncX4M300"].set_member(func.name, awaited)
