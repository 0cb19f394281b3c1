"""npm's kaitai-struct-compiler takes our file; its parser reads every golden payload alike."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from hil_tests.unit.xethru_protocol.export.test_wireshark import (
    NAMELESS,
    VECTORS,
    expected_fields,
    same,
)
from xethru_protocol.cli import main as xethru

MODULES = "XETHRU_KAITAI_MODULES"
# Prints a line of JSON per vector: the name of its member, and its fields, those of cases inlined.
PROGRAM = r"""
const fs = require("fs"), path = require("path"), Module = require("module");
const compiler = require("kaitai-struct-compiler"), yaml = require("js-yaml");
const runtime = require("kaitai-struct/KaitaiStream");
const text = (v) => v instanceof Uint8Array
  ? Buffer.from(v).toString("hex").match(/../g)?.join(":") ?? ""
  : Array.isArray(v) ? v.map(text) : v === undefined ? null : String(v);
const flat = (o, out) => {
  for (const [key, v] of Object.entries(o)) {
    if (key.startsWith("_") || v === undefined || v === null) continue;
    if (typeof v === "object" && !Array.isArray(v) && !(v instanceof Uint8Array)) flat(v, out);
    else out[key] = text(v);
  }
  return out;
};
(async () => {
  const ksy = yaml.load(fs.readFileSync("xethru.ksy", "utf8"));
  const files = await compiler.compile("javascript", ksy, null, false);
  for (const [name, code] of Object.entries(files)) fs.writeFileSync(name, code);
  const made = require(path.resolve("Xethru.js"));
  const Xethru = made.Xethru && made.Xethru.ResponsePayload ? made.Xethru : made;
  for (const [host, hex] of JSON.parse(fs.readFileSync("payloads.json"))) {
    const Type = host ? Xethru.CommandPayload : Xethru.ResponsePayload;
    const parsed = new Type(new runtime(Uint8Array.from(Buffer.from(hex, "hex")).buffer));
    const named = Object.entries(parsed).filter(([k, v]) => !k.startsWith("_") && v);
    console.log(JSON.stringify(named.map(([k, v]) => [k, flat(v, {})])));
  }
})().catch((error) => { console.error(error); process.exit(1); });
"""


def test_every_vector_is_parsed_with_its_fields(tmp_path: Path) -> None:
    node, modules = shutil.which("node"), os.environ.get(MODULES)
    if node is None or modules is None:
        pytest.skip(f"{MODULES} names no node_modules with kaitai-struct-compiler, or no node")
    vectors = [v for v in VECTORS if v.payload is not None and v.name not in NAMELESS]
    assert xethru(["export", "kaitai", "--out", str(tmp_path / "xethru.ksy")]) == 0
    (tmp_path / "program.js").write_text(PROGRAM)
    payloads = [(v.from_host, (v.payload or b"").hex()) for v in vectors]
    (tmp_path / "payloads.json").write_text(json.dumps(payloads))
    ended = subprocess.run(
        [node, "program.js"],
        cwd=tmp_path,
        env=os.environ | {"NODE_PATH": modules},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    wrong = []
    for vector, line in zip(vectors, ended.stdout.splitlines(), strict=True):
        ((_, shown),) = json.loads(line)
        shown |= {
            key.removesuffix("Short"): value for key, value in shown.items() if "Short" in key
        }
        for key, value in expected_fields(vector).items():
            first, *others = key.split("_")
            found = shown.get(first + "".join(word.capitalize() for word in others))
            if isinstance(found, str) and isinstance(value, str) and ":" not in found:
                found = found.removesuffix("\0")
            if not same(found, value):
                wrong.append(f"{vector.name}.{key}: {found} != {value}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("tool", ["kaitai", "wireshark"])
def test_what_is_printed_is_the_file(
    tool: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert xethru(["export", tool, "--out", str(tmp_path / "file")]) == 0
    assert xethru(["export", tool]) == 0
    assert capsys.readouterr().out == (tmp_path / "file").read_text()
