// Messages of the server: a length (u32, little-endian), that many bytes of JSON, and a payload.

/** Splits a message into its JSON and its payload. Throws if it is malformed. */
export function parseMessage(buffer) {
  if (buffer.byteLength < 4) throw new Error("a message is shorter than its length field");
  const length = new DataView(buffer).getUint32(0, true);
  if (length > buffer.byteLength - 4) throw new Error("a message is shorter than it says");
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  if (json === null || typeof json !== "object") throw new Error("a message is no object");
  return { ...json, payload: new Uint8Array(buffer, 4 + length) };
}

const MEDIA_TYPES = { jpeg: "image/jpeg", png: "image/png" };

/** Media type of an encoding that browsers show; undefined for others (`exr`, `raw`). */
export const mediaType = (encoding) => MEDIA_TYPES[encoding];
