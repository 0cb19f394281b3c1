"""Write `docs/protocol.md`, the protocol as the message table has it: `python -m` this."""

from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path

from hil_tests.architecture.pages.markdown import table, write
from hil_tests.paths import REPOSITORY
from xethru_protocol.export.description import PayloadField, PayloadLayout, layouts
from xethru_protocol.wire import codes

PAGE = REPOSITORY / "docs" / "protocol.md"

HEAD = """# Protocol reference

What is on the wire between a host and a module, from the message table in
`xethru_protocol/wire/messages.py`. This page is made of the source:
`python -m hil_tests.architecture.pages.protocol` writes it. Numbers in text refer to the sections
of the reference that the table was written from.

## Framing

A payload travels in one of two framings. Hosts send Normal packets only; modules send radar frames
and other bulk data as NoEscape packets. All numbers are little-endian without padding.

| framing | bytes | notes |
|---|---|---|
| Normal | `7D` payload checksum `7E` | XOR of `7D` and payload; `7F` stands before 7D, 7E, 7F |
| NoEscape | `7C 7C 7C 7C` length (u32) `00` payload | no escapes, no checksum, no end |

## Wireshark and Kaitai

`xethru export` writes the same table for two other tools:

```console
$ xethru export kaitai --out xethru.ksy
$ xethru export wireshark --out xethru.lua
$ xethru record --port /dev/ttyACM0 --wire live.xtwire --count 5
$ xethru convert live.xtwire live.pcap
```

Wireshark takes the same options as tshark. A record of the pcap file is one packet of the wire
behind a byte for its direction, `3C` from the module or `3E` from the host; its link type is 147
(USER0). These are lines of such a recording of an emulated module (`-Y 'xethru.message ==
"DATA FLOAT"'` would leave the frames only):

<!-- not run: needs tshark -->
```console
$ tshark -X lua_script:xethru.lua -r live.pcap
   55 0.011072893         host → module       XeThru 10 X4DRIVER_GET
   56 0.011368522       module → host         XeThru 23 REPLY FLOAT
   57 0.024970407       module → host         XeThru 5748 DATA FLOAT
   58 0.083695077       module → host         XeThru 5748 DATA FLOAT
```

In the tables below `[n]` is a list with as many entries as the field `n`, `[*]` takes the bytes
that are left, and a `?` marks a field that may be absent.
"""


def documents() -> dict[Path, str]:
    found = layouts()
    parts = [HEAD]
    for title, from_host in (("From the host", True), ("From the module", False)):
        parts.append(f"## {title}\n")
        parts += [_section(layout) for layout in found if layout.from_host is from_host]
    parts.append("## Enumerations\n")
    for kind in vars(codes).values():
        if isinstance(kind, type) and issubclass(kind, int) and kind.__module__ == codes.__name__:
            parts += [f"### {kind.__name__}\n", (kind.__doc__ or "").partition("\n")[0] + "\n"]
            parts.append(table(("value", "name"), _members(kind), ["value"]))
    return {PAGE: "\n".join(parts)}


def _members(kind: type) -> Iterator[tuple[str, str]]:
    members: list[IntEnum] = list(kind)  # type: ignore[call-overload] # the caller passes enumerations
    for member in members:
        yield f"`{member.value:02X}`", f"`{member.name}`"


def _section(layout: PayloadLayout) -> str:
    first, *others = (f"`{prefix.hex(' ').upper()}`" for prefix in layout.prefixes)
    begins = f"{first} and {len(others)} others" if len(others) > 3 else ", ".join([first, *others])
    lines = [f"### {layout.name}\n", f"{layout.text}\n", f"Begins with {begins}."]
    if layout.replies:
        lines[-1] += f" Reply: {' or '.join(layout.replies)}."
    lines[-1] += "\n"
    if layout.fields:
        lines.append(table(("field", "type", "values"), _rows(layout.fields), []))
    return "\n".join(lines)


def _rows(fields: tuple[PayloadField, ...], when: str = "") -> Iterator[tuple[str, str, str]]:
    for field in fields:
        if field.cases:
            for code, case in field.cases:
                yield from _rows(case, f"{field.on} = {code:02X}h")
            continue
        count = f"{field.count} × {field.per}" if field.per > 1 else field.count
        kind = field.type + (f"[{count}]" if count else "") + ("?" if field.beyond >= 0 else "")
        kind += " or u1" if field.short else ""
        yield f"`{field.name}`", kind, when or (f"`{field.enum.__name__}`" if field.enum else "")


if __name__ == "__main__":
    write(documents())
