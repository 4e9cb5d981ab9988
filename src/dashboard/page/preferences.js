// What is remembered: the token for this tab, the theme, and whether axes are drawn.

const TOKEN_KEY = `ridgewatch-token:${location.pathname}`;
const THEME_KEY = "ridgewatch-theme";

// Storage may be forbidden, for instance in a frame of another site.
function read(storage, key) {
  try { return window[storage].getItem(key); } catch { return null; }
}

function write(storage, key, value) {
  try { window[storage].setItem(key, value); } catch { /* remembered until the page is closed */ }
}

/** What was chosen for a part of the page; null if nothing was. */
export const recall = (name) => read("localStorage", `ridgewatch-${name}`);
export const remember = (name, value) => write("localStorage", `ridgewatch-${name}`, value);

/** The token of the page's address, or of an earlier visit in this tab; null without one. It is removed from the address, which may be shown to others. */
export function takeToken() {
  const address = new URL(location.href);
  const token = address.searchParams.get("token");
  if (token === null) return read("sessionStorage", TOKEN_KEY);
  write("sessionStorage", TOKEN_KEY, token);
  address.searchParams.delete("token");
  history.replaceState(null, "", address);
  return token;
}

const systemTheme = matchMedia("(prefers-color-scheme: dark)");

const theme = () => document.documentElement.dataset.theme ?? (systemTheme.matches ? "dark" : "light");

/** Applies the remembered theme, and calls `changed` whenever the colours change. Returns a function that switches. */
export function followTheme(changed) {
  const stored = read("localStorage", THEME_KEY);
  if (stored === "dark" || stored === "light") document.documentElement.dataset.theme = stored;
  systemTheme.addEventListener("change", changed);
  return () => {
    const next = theme() === "dark" ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    write("localStorage", THEME_KEY, next);
    changed();
  };
}
