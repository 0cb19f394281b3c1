// A client of Foxglove's own packages: it subscribes to all topics of a server, takes every message apart, and prints
// one JSON object when it has had one of each topic that it was asked for:
// {topic: {"type", "count", "t_ns", "message": the last one}}.
// node foxglove_client.mjs MODULES PORT TOPIC...
import { createRequire } from "node:module";

const [modules, port, ...wanted] = process.argv.slice(2);
const require = createRequire(`${modules}/`);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { parse } = require("@foxglove/rosmsg");
const WebSocket = require("ws");

const found = {};
const channels = new Map();

function connect() {
  const socket = new WebSocket(`ws://127.0.0.1:${port}`, ["foxglove.sdk.v1"]);
  const client = new FoxgloveClient({ ws: socket });
  client.on("error", () => setTimeout(connect, 100)); // it does not listen yet
  client.on("advertise", (advertised) => {
    for (const channel of advertised) {
      if (channel.encoding !== "cdr" || channel.schemaEncoding !== "ros2msg") {
        throw new Error(`${channel.topic}: ${channel.encoding}, ${channel.schemaEncoding}`);
      }
      const reader = new MessageReader(parse(channel.schema, { ros2: true }));
      channels.set(client.subscribe(channel.id), { channel, reader });
    }
  });
  client.on("message", ({ subscriptionId, timestamp, data }) => {
    const { channel, reader } = channels.get(subscriptionId);
    const count = (found[channel.topic]?.count ?? 0) + 1;
    const message = reader.readMessage(data);
    found[channel.topic] = { type: channel.schemaName, count, t_ns: String(timestamp), message };
    if (wanted.every((topic) => topic in found)) {
      const plain = (_, value) => (ArrayBuffer.isView(value) ? Array.from(value) : value);
      process.stdout.write(JSON.stringify(found, plain) + "\n", () => process.exit(0));
    }
  });
}
connect();
