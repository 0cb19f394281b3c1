"""The message table as a Wireshark dissector in Lua, for pcap files of `recordings.pcap`."""

from xethru_protocol.export.description import SIZES, PayloadField, PayloadLayout, layouts

_HEAD = """\
-- Wireshark dissector of the XeThru module protocol, written by `xethru export wireshark`.
-- wireshark -X lua_script:xethru.lua FILE.pcap
-- Each packet (link type USER0) is a byte, 3C from the module or 3E from the host, then one packet
-- of the wire as it was captured, or bytes that belong to none.
local xethru = Proto("xethru", "XeThru module protocol")
local fields, messages = {}, {}
"""

_TAIL = """
local direction = ProtoField.string("xethru.direction", "Direction")
local framing = ProtoField.string("xethru.framing", "Framing")
local name = ProtoField.string("xethru.message", "Message")
local checksum = ProtoField.uint8("xethru.checksum", "Checksum", base.HEX)
local all = {direction, framing, name, checksum}
for _, field in pairs(fields) do all[#all + 1] = field end
xethru.fields = all
local malformed = ProtoExpert.new(
  "xethru.malformed", "Malformed", expert.group.MALFORMED, expert.severity.ERROR)
xethru.experts = {malformed}

local readers = {
  u1 = function(range) return range:uint() end,
  u2be = function(range) return range:uint() end,
  u4 = function(range) return range:le_uint() end,
  s4 = function(range) return range:le_int() end,
  s2 = function(range) return range:le_int() end,
  f4 = function(range) return range:le_float() end,
}

-- Adds fields from `at` on and returns the offset behind them; nil if the bytes are too few.
local function walk(message, list, payload, at, tree, values)
  for _, f in ipairs(list) do
    local left = payload:len() - at
    if f.cases then
      local case = f.cases[values[f.on]]
      if not case then return nil end
      at = walk(message, case, payload, at, tree, values)
      if not at then return nil end
    elseif left > f.beyond then
      local field = fields[message.id .. "." .. f.name .. "." .. f.type]
      local size = f.size
      local number = 1
      if f.count == "*" then
        number = left
      elseif f.count then
        number = (values[f.count] or 0) * f.per
      end
      if f.short and left == 1 then size = 1 end
      if number * size > left then return nil end
      if f.type == "bytes" or f.type == "text" then
        local range = number > 0 and payload:range(at, number) or nil
        if f.type == "bytes" then
          if range then tree:add(field, range) end
        elseif range then
          local text = range:raw():gsub("%z$", "")
          tree:add(field, range, text:gsub("[\\128-\\255]", function(c)
            local b = c:byte()
            return string.char(0xC0 + math.floor(b / 64), 0x80 + b % 64)
          end))
        else
          tree:add(field, "")
        end
        at = at + number
      else
        for _ = 1, number do
          local range = payload:range(at, size)
          local value = readers[f.type](range)
          if f.type == "u2be" then tree:add(field, range) else tree:add_le(field, range) end
          if not f.count then values[f.name] = value end
          at = at + size
        end
      end
      at = at + f.skip
    end
  end
  return at
end

-- Returns payload bytes, framing and checksum; or nil and what is wrong.
local function unframe(data)
  if data:sub(1, 4) == "\\124\\124\\124\\124" then
    if #data < 9 then return nil, "NoEscape header cut" end
    local a, b, c, d = data:byte(5, 8)
    if a + b * 256 + c * 65536 + d * 16777216 ~= #data - 9 then
      return nil, "NoEscape length does not fit"
    end
    return data:sub(10), "noescape"
  end
  if data:byte(1) ~= 0x7D then return nil, "no start byte" end
  local out, sum, i = {}, 0x7D, 2
  while i <= #data do
    local b = data:byte(i)
    if b == 0x7E then break end
    if b == 0x7D then return nil, "start byte inside a packet" end
    if b == 0x7F then
      i = i + 1
      b = data:byte(i)
      if not b then return nil, "no end byte" end
    end
    out[#out + 1] = b
    i = i + 1
  end
  if i ~= #data then return nil, "no end byte" end
  if #out < 2 then return nil, "no payload" end
  for n = 1, #out do
    local a, b, bit, x = sum, out[n], 1, 0
    while bit < 256 do
      if a % 2 ~= b % 2 then x = x + bit end
      a, b, bit = math.floor(a / 2), math.floor(b / 2), bit * 2
    end
    sum = x
  end
  local last = table.remove(out)
  if sum ~= 0 then return nil, "wrong checksum" end
  local parts = {}
  for n = 1, #out do parts[n] = string.char(out[n]) end
  return table.concat(parts), "normal", last
end

function xethru.dissector(buffer, info, root)
  info.cols.protocol = "XeThru"
  local tree = root:add(xethru, buffer())
  if buffer:len() == 0 then return end
  local from_host = buffer(0, 1):uint() == 0x3E
  tree:add(direction, buffer(0, 1), from_host and "host" or "module")
  info.cols.src = from_host and "host" or "module"
  info.cols.dst = from_host and "module" or "host"
  local data = buffer:len() > 1 and buffer:range(1):raw() or ""
  local bytes, kind, sum = unframe(data)
  if not bytes then
    info.cols.info = "damaged: " .. kind
    tree:add_proto_expert_info(malformed, kind)
    return
  end
  tree:add(framing, kind)
  if sum then tree:add(checksum, sum) end
  local payload
  if kind == "noescape" then
    if #bytes == 0 then
      info.cols.info = "empty"
      return
    end
    payload = buffer:range(10):tvb()
  else
    payload = ByteArray.new(bytes, true):tvb("Unescaped payload")
  end
  local table_ = messages[from_host and "host" or "module"]
  for length = 6, 1, -1 do
    local message = table_[bytes:sub(1, length)]
    if message and #bytes >= length then
      tree:add(name, payload:range(0, length), message.name)
      info.cols.info = message.name
      if not walk(message, message.fields, payload, length, tree, {}) then
        tree:add_proto_expert_info(malformed, "shorter than its fields")
      end
      return
    end
  end
  tree:add(name, payload:range(), "UNKNOWN")
  info.cols.info = "UNKNOWN"
end
DissectorTable.get("wtap_encap"):add(wtap.USER0, xethru)
"""

_FIELDS = {
    "u1": "uint8",
    "u2be": "uint16",
    "u4": "uint32",
    "s4": "int32",
    "s2": "int16",
    "f4": "float",
    "bytes": "bytes",
    "text": "string",
}


def dissector() -> str:
    """Return the dissector."""
    parts = [_HEAD, "messages.host, messages.module = {}, {}\nlocal message\n"]
    for layout in layouts():
        declared = {_declaration(layout, field) for field in _all(layout.fields)}
        parts += sorted(declared)
        parts.append(
            f'message = {{name = "{layout.name}", id = "{layout.id}", '
            f"fields = {_list(layout.fields)}}}\n"
        )
        side = "host" if layout.from_host else "module"
        parts += [f'messages.{side}["{_bytes(prefix)}"] = message\n' for prefix in layout.prefixes]
    return "".join([*parts, _TAIL])


def _all(fields: tuple[PayloadField, ...]) -> list[PayloadField]:
    inner = [one for field in fields for _, case in field.cases for one in _all(case)]
    return [field for field in fields if not field.cases] + inner


def _declaration(layout: PayloadLayout, field: PayloadField) -> str:
    # An abbreviation has one type in Wireshark; a field whose type another decides has several.
    types = {one.type for one in _all(layout.fields) if one.name == field.name}
    end = f".{field.type}" if len(types) > 1 else ""
    extra = ""
    if field.enum is not None:
        names = ", ".join(f'[{one.value}] = "{one.name}"' for one in field.enum)
        extra = f", base.DEC, {{{names}}}"
    return (
        f'fields["{layout.id}.{field.name}.{field.type}"] = ProtoField.{_FIELDS[field.type]}('
        f'"xethru.{layout.id}.{field.name}{end}", "{field.name}"{extra})\n'
    )


def _list(fields: tuple[PayloadField, ...]) -> str:
    return "{" + ", ".join(map(_field, fields)) + "}"


def _field(field: PayloadField) -> str:
    if field.cases:
        cases = ", ".join(f"[{code}] = {_list(case)}" for code, case in field.cases)
        return f'{{on = "{field.on}", cases = {{{cases}}}}}'
    count = f'"{field.count}"' if field.count else "nil"
    return (
        f'{{name = "{field.name}", type = "{field.type}", size = {SIZES[field.type]}, '
        f"count = {count}, per = {field.per}, beyond = {field.beyond}, skip = {field.skip}, "
        f"short = {str(field.short).lower()}}}"
    )


def _bytes(data: bytes) -> str:
    return "".join(f"\\{byte:03d}" for byte in data)
