// Payloads are scripts that call put(name, value): the same files open from file:// and from a server.
"use strict";
const SCHEMA = 2, KEPT = 64;
const store = new Map(), pending = new Map(), decoded = new Map(), refused = new Map();

function put(name, value) { store.set(name, value); refused.delete(name); }
/* What a server says of data that it cannot make, such as those of a damaged run. */
function refuse(name, words) { refused.set(name, words); }

function load(name, again = false) {
  if (store.has(name) && !again) return Promise.resolve(store.get(name));
  if (!pending.has(name)) pending.set(name, new Promise((done, fail) => {
    const tag = document.createElement("script");
    const end = (settle) => { pending.delete(name); tag.remove(); settle(); };
    tag.src = `data/${name.split("/").map(encodeURIComponent).join("/")}.js${again ? `?n=${++requests}` : ""}`;
    tag.onload = () => end(() => (refused.has(name) || !store.has(name) ? fail(new Error(refused.get(name) ?? `data/${name}.js holds something else`)) : done(store.get(name))));
    tag.onerror = () => end(() => fail(new Error(`data/${name}.js is missing or cannot be read`)));
    document.head.append(tag);
  }));
  return pending.get(name);
}
let requests = 0;

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}
/* Decoded arrays by their text; the oldest are dropped, so that memory stays bounded. */
function once(text, make) {
  if (!decoded.has(text)) {
    if (decoded.size >= 12 * KEPT) decoded.delete(decoded.keys().next().value);
    decoded.set(text, make());
  }
  return decoded.get(text);
}
const floats = (text) => once(text, () => new Float32Array(bytes(text)));
const MISSING = -32768;
const logOdds = (text) => once(text, () => Float32Array.from(new Int16Array(bytes(text)), (v) => (v === MISSING ? NaN : v / 256)));
const spread = (coded) => coded.codes.map((code) => coded.words[code]);
