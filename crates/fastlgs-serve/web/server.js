// Requests to the program that serves this page.

const address = new URL(location.href);
const given = address.searchParams.get("token");
// The token must not stay where others can read it over one's shoulder; a page that is loaded again knows it still.
if (given) {
  remembered((place) => place.setItem("token", given));
  address.searchParams.delete("token");
  history.replaceState(null, "", address);
}

const token = given ?? remembered((place) => place.getItem("token"));

// What the browser keeps for this tab; nothing where it keeps nothing.
function remembered(use) {
  try {
    return use(sessionStorage);
  } catch {
    return null;
  }
}

async function request(path, options = {}) {
  const headers = { ...options.headers };
  if (token) headers.Authorization = `Bearer ${token}`;
  let response;
  try {
    // Relative to the page, which a proxy may show below a prefix.
    response = await fetch(new URL(path.slice(1), document.baseURI), { ...options, headers });
  } catch {
    throw new Error("the server does not answer; is fastlgs still running?");
  }
  if (!response.ok) {
    const body = await response.json().catch(() => ({}));
    throw Object.assign(new Error(body.error ?? `${path}: ${response.status}`), { status: response.status });
  }
  return response;
}

const posted = (body) => ({
  method: "POST",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(body),
});

export const getJson = async (path) => (await request(path)).json();
export const getBytes = async (path) => (await request(path)).arrayBuffer();
export const getBlob = async (path) => (await request(path)).blob();
export const postJson = async (path, body) => (await request(path, posted(body))).json();
export const postBlob = async (path, body) => (await request(path, posted(body))).blob();
