// SPDX-License-Identifier: Apache-2.0
// Prints every message of an MCAP file as one line of JSON: topic, both times, and all values by
// name as texts. Numbers with a fraction are the bits of a float64, so that nothing is rounded.

import { readFile } from 'node:fs/promises';

import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import lz4 from '@foxglove/wasm-lz4';
import { McapIndexedReader } from '@mcap/core';

const bits = new DataView(new ArrayBuffer(8));

function text(type, value) {
  if (type !== 'float32' && type !== 'float64') {
    return String(value);
  }
  if (Number.isNaN(value)) {
    return 'nan';
  }
  bits.setFloat64(0, value);
  return bits.getBigUint64(0).toString(16).padStart(16, '0');
}

function collect(values, name, type, value, definitions) {
  const fields = definitions.get(type);
  if (fields) {
    collectFields(values, `${name}.`, fields, value, definitions);
  } else if (type === 'time' || type === 'duration') {
    values[`${name}.sec`] = String(value.sec);
    values[`${name}.nanosec`] = String(value.nanosec);
  } else {
    values[name] = text(type, value);
  }
}

function collectFields(values, prefix, fields, message, definitions) {
  for (const field of fields.filter((field) => !field.isConstant)) {
    const name = `${prefix}${field.name}`;
    const value = message[field.name];
    if (field.isArray) {
      Array.from(value).forEach((element, index) => {
        collect(values, `${name}[${index}]`, field.type, element, definitions);
      });
    } else {
      collect(values, name, field.type, value, definitions);
    }
  }
}

class Decoder {
  constructor(schema) {
    const parsed = parse(new TextDecoder().decode(schema.data), { ros2: true });
    this.root = parsed.find((definition) => !definition.name).definitions;
    this.definitions = new Map(parsed.map((each) => [each.name, each.definitions]));
    this.reader = new MessageReader(parsed);
  }

  decode(data) {
    const values = {};
    collectFields(values, '', this.root, this.reader.readMessage(data), this.definitions);
    return values;
  }
}

await lz4.isLoaded;
const file = await readFile(process.argv[2]);
const mcap = await McapIndexedReader.Initialize({
  readable: {
    size: async () => BigInt(file.byteLength),
    read: async (offset, size) => file.subarray(Number(offset), Number(offset + size)),
  },
  decompressHandlers: { lz4: (data, size) => lz4(data, Number(size)) },
});
const decoders = new Map();
for await (const message of mcap.readMessages({ validateCrcs: true })) {
  const channel = mcap.channelsById.get(message.channelId);
  if (!decoders.has(channel.schemaId)) {
    decoders.set(channel.schemaId, new Decoder(mcap.schemasById.get(channel.schemaId)));
  }
  const values = decoders.get(channel.schemaId).decode(message.data);
  const line = [channel.topic, String(message.logTime), String(message.publishTime), values];
  process.stdout.write(`${JSON.stringify(line)}\n`);
}
