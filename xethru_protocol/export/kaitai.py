"""The message table as a Kaitai Struct file."""

from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any

from xethru_protocol.export.description import SIZES, PayloadField, PayloadLayout, layouts

_HEAD = """# XeThru module protocol, written by `xethru export kaitai`.
# The root type reads NoEscape packets of a module, one behind the other. Payloads of Normal packets
# (7D, escaped payload and XOR checksum, 7E) are unescaped first; then the types response_payload
# (from the module) and command_payload (from the host) read them.
"""


def structure() -> str:
    """Return the file."""
    found = layouts()
    types: dict[str, Any] = {
        "no_escape_packet": {
            "seq": [
                {"id": "magic", "contents": [0x7C] * 4},
                {"id": "len_payload", "type": "u4"},
                {"id": "reserved", "type": "u1"},
                {"id": "payload", "size": "len_payload", "type": "response_payload"},
            ]
        },
        "response_payload": _payload([one for one in found if not one.from_host]),
        "command_payload": _payload([one for one in found if one.from_host]),
    }
    enums: dict[str, Any] = {}
    for layout in found:
        size = len(layout.prefixes[0])
        head = {"id": "opcode", "size": size}
        name = _type(layout)
        types[name] = {"seq": [head, *_seq(layout.fields, name, size, types, enums)]}
    file = {
        "meta": {"id": "xethru", "title": "XeThru module protocol", "endian": "le"},
        "seq": [{"id": "packets", "type": "no_escape_packet", "repeat": "eos"}],
        "types": types,
        "enums": enums,
    }
    return _HEAD + "\n".join(_yaml(file, "")) + "\n"


def _type(layout: PayloadLayout) -> str:
    return f"{'command' if layout.from_host else 'response'}_{layout.id}"


def _payload(found: Sequence[PayloadLayout]) -> dict[str, Any]:
    longest = max(len(prefix) for layout in found for prefix in layout.prefixes)
    return {
        "seq": [
            {"id": layout.id, "type": _type(layout), "if": _condition(layout.prefixes)}
            for layout in found
        ],
        "instances": {
            f"b{n}": {"pos": n, "type": "u1", "if": f"_io.size > {n}"} for n in range(longest)
        },
    }


def _condition(prefixes: Sequence[bytes]) -> str:
    *first, _ = prefixes[0]
    last = " or ".join(f"b{len(first)} == {prefix[-1]:#04x}" for prefix in prefixes)
    parts = [f"_io.size >= {len(first) + 1}"]
    parts += [f"b{n} == {byte:#04x}" for n, byte in enumerate(first)]
    return " and ".join([*parts, f"({last})"])


def _seq(
    fields: Sequence[PayloadField],
    owner: str,
    offset: int,
    types: dict[str, Any],
    enums: dict[str, Any],
) -> Iterator[dict[str, Any]]:
    """Yield the attributes of fields that begin ``offset`` bytes behind the payload's start."""
    present: dict[str, str] = {}  # the condition of a count that may be absent
    kinds = {field.name: field for field in fields}
    for field in fields:
        one: dict[str, Any] = {"id": field.name}
        if field.cases:
            key = field.on + (".to_i" if kinds[field.on].enum else "")
            cases: dict[int, str] = {}
            for code, case in field.cases:
                cases[code] = f"{owner}_{code}"
                types[cases[code]] = {"seq": [*_seq(case, cases[code], offset, types, enums)]}
            yield one | {"type": {"switch-on": key, "cases": cases}}
            continue
        if field.type in {"bytes", "text"}:
            one |= {"size-eos": True} if field.count == "*" else {"size": field.count}
            if field.type == "text":
                one |= {"type": "str", "encoding": "ISO-8859-1"}
        else:
            one |= {"type": field.type}
            if field.count:
                one |= {"repeat": "expr", "repeat-expr": f"{field.count} * {field.per}"}
        if field.enum is not None:
            one |= {"enum": _enum(field.enum, enums)}
        if field.count in present:
            one |= {"if": present[field.count]}
        elif field.beyond >= 0:
            counts = any(other.count == field.name for other in fields)
            condition = f"_io.size > {offset + field.beyond}" if counts else "not _io.eof"
            present[field.name] = condition
            one |= {"if": condition}
        if field.short:
            yield one | {"if": "_io.size - _io.pos > 1"}
            one |= {"id": f"{field.name}_short", "type": "u1", "if": "not _io.eof"}
        yield one
        if field.skip:
            yield {"id": f"{field.name}_padding", "size": field.skip}
        offset += SIZES[field.type] + field.skip


def _enum(kind: type[IntEnum], enums: dict[str, Any]) -> str:
    name = "".join(f"_{c.lower()}" if c.isupper() else c for c in kind.__name__).lstrip("_")
    enums[name] = {member.value: member.name.lower() for member in kind}
    return name


def _yaml(value: Mapping[Any, Any], indent: str) -> Iterator[str]:
    for key, item in value.items():
        if isinstance(item, dict):
            yield f"{indent}{key}:"
            yield from _yaml(item, indent + "  ")
        elif isinstance(item, list) and isinstance(item[0], dict):
            yield f"{indent}{key}:"
            for one in item:
                first, *rest = _yaml(one, "")
                yield f"{indent}  - {first}"
                yield from (f"{indent}    {line}" for line in rest)
        elif isinstance(item, bool):
            yield f"{indent}{key}: {str(item).lower()}"
        else:
            yield f"{indent}{key}: {item}"
