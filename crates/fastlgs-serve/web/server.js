// Requests to the server of this page.

const address = new URL(location.href);
const given = address.searchParams.get("token");
// Removes the token from the visible address. Session storage keeps it for reloads.
if (given) {
  withStorage((place) => place.setItem("token", given));
  address.searchParams.delete("token");
  history.replaceState(null, "", address);
}

const token = given ?? withStorage((place) => place.getItem("token"));

// Uses the session storage; returns null if the browser has none.
function withStorage(use) {
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
    // Relative to the page, because a proxy may add a path prefix.
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
