// Replaces server.js in a static folder: reads the scene, and the answers to common words, from
// files.

// Number of objects per row. src/share.rs writes the table, with one row per word.
const CANDIDATES = 8;
const ROW = 2 + 3 * CANDIDATES;
// Number of suggestions for an unknown text.
const SUGGESTIONS = 5;

async function file(path) {
  const response = await fetch(path).catch(() => null);
  if (!response?.ok) throw new Error(`${path} is missing beside this page; copy the whole folder`);
  return response;
}

export const getJson = async (path) => (await file(`data${path.slice(4)}.json`)).json();
export const getBytes = async (path) => (await file(`data${path.slice(4)}.bin`)).arrayBuffer();
export const getBlob = async (path) => (await file(`data${path.slice(4).replace(/png$/, "jpg")}`)).blob();
export const postBlob = async () => { throw new Error("this page is a static folder, which cannot render pictures"); };

let table;

async function words() {
  const [list, rows] = await Promise.all([getJson("/api/words"), getBytes("/api/words")]);
  return { list: new Map(list.map((word, place) => [word, place])), rows: new DataView(rows) };
}

// Normalises a text like `normalised` of crates/fastlgs/src/query/phrase.rs, in lower case.
function phrase(text) {
  const invisible = /[\u00ad\u200b-\u200f\u202a-\u202e\u2060-\u2064\ufeff]/g;
  const separators = /["`\u00b4\u00ab\u00bb()[\]{}<>\-_\u2010-\u2015\u2212\u2018-\u201f]|(?<![\p{L}\p{N}])'|'(?![\p{L}\p{N}])/gu;
  const composed = text.normalize("NFC").toLowerCase().replace(invisible, "").replace(/(?<=[\p{L}\p{N}])\u2019(?=[\p{L}\p{N}])/gu, "'");
  const words = composed.replace(separators, " ").trim().split(/\s+/).join(" ").replace(/^[.,;:!?\u00bf\u00a1]+|[.,;:!?]+$/g, "");
  return words.replace(/^((a|an|the) )+(?=.)/, "");
}

// Returns the edit distance of two words (Levenshtein).
function distance(a, b) {
  let row = Array.from({ length: b.length + 1 }, (_, k) => k);
  for (let i = 1; i <= a.length; i++) {
    const next = [i];
    for (let k = 1; k <= b.length; k++) next.push(Math.min(row[k] + 1, next[k - 1] + 1, row[k - 1] + (a[i - 1] === b[k - 1] ? 0 : 1)));
    row = next;
  }
  return row[b.length];
}

// Suggests known words for an unknown text: words in it, then words with similar spelling.
function near(text, list) {
  const inside = text.split(/\s+/).filter((word) => word !== text && list.has(word));
  const written = [...list.keys()].filter((word) => Math.abs(word.length - text.length) < 4).map((word) => [distance(text, word), word]);
  written.sort((a, b) => a[0] - b[0]);
  return [...new Set([...inside.reverse(), ...written.map(([, word]) => word)])].slice(0, SUGGESTIONS);
}

// Answers a text from the table, in the format of the server.
export async function postJson(path, { text }) {
  const began = performance.now();
  // After an error, the next query fetches the table again.
  table ??= words().catch((error) => {
    table = undefined;
    throw error;
  });
  const { list, rows } = await table;
  const typed = text.trim().toLowerCase().replace(/\s+/g, " ");
  const plain = list.has(typed) ? typed : phrase(text);
  const place = list.get(plain);
  if (place === undefined) {
    const known = `${list.size.toLocaleString("en")} words`;
    throw new Error(`this page answers ${known}, and "${plain}" is not among them; similar words: ${near(plain, list).join(", ")}`);
  }
  const at = ROW * place;
  const candidates = Array.from({ length: CANDIDATES }, (_, k) => {
    const from = at + 2 + 3 * k;
    return { id: rows.getUint16(from, true), score: rows.getUint8(from + 2) / 255 };
  }).filter(({ id }) => id > 0);
  const objects = candidates.slice(0, rows.getUint8(at + 1));
  const score = rows.getUint8(at) / 255;
  return { candidates, objects, score, found: objects.length > 0, ms: { total: performance.now() - began } };
}
