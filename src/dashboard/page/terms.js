// Terms of the trade, explained on hover, focus or tap. A term is `<button class="term" data-term="tau">`.

const TERMS = {
  ftle: "FTLE (finite-time Lyapunov exponent): how fast neighbouring particles part within the time tau. Its ridges separate regions that do not mix.",
  t0: "t0: the time at which the particles are seeded.",
  tau: "tau: how long particles are followed from t0, forward or backward in time.",
  window: "Window: the span of flow data from t0 to t0 + tau (backward: − tau) that the picture needs.",
  slide: "Slide: the window moves on by one step; frames of one slide refine the same picture.",
  traced: "Traced: share of the picture's queries answered by integrating particle paths. The surrogate answered the rest, which is faster but approximate. Of two_level and marched, whose picture a table or network draws, the points are told that were traced to correct it or to measure its error.",
  trace_budget: "Tracing budget: the most time for tracing in a frame (trust.trace_budget). Once it is spent, the surrogate also answers where it is not trusted.",
  tolerance: "Tolerance: largest error of the surrogate that is trusted, as a root mean square of the optical residual, in which 1 is the whole colour scale.",
  surrogate_error: "Error of the surrogate: root mean square of the optical residual where the surrogate is trusted, before any correction. Once the tracing budget is spent, also where it is not trusted, if that is more; what is within the tolerance there counts as large as that.",
  optical: "Optical residual: error of the surrogate as it shows in the picture: the difference of two places on the colour scale, in which 1 is the whole scale.",
  stretch: "Log-stretch: FTLE times tau, the logarithm of the factor by which neighbours part.",
  ramp: "Optical ramp: how the FTLE becomes opacity, from 0 at its lower to 1 at its upper end.",
  extinction: "Extinction: how much light is lost on a unit of length where the FTLE is at the upper end of the colours; more makes the structures more opaque.",
  majorant: "Majorant: upper bound of the opacity, by which samples along a ray are drawn. Where the opacity exceeded it, the picture is too transparent.",
  budget: "Budget: milliseconds for the picture of a frame; fewer make it faster and noisier. Only the method two_level has one.",
  psnr: "PSNR: how close the picture is to the exact one, over its lit pixels, in decibels. 40 dB is an error of 1 % of full brightness (root mean square), 20 dB 10 %.",
  trusted: "Trusted: part of the domain in which the surrogate's measured error is within the tolerance.",
  surrogate: "Surrogate: a table or neural network that predicts what tracing would give.",
  lag: "Lag: seconds from the publication of a simulation step until the frame that contains it was finished. The way to this page is not included.",
  loss: "Loss: what training of the surrogate minimises; smaller is better.",
};

// How messages write the terms that they use; the longer words first. Parts of settings (`trust.tolerance`), of names and of paths are none.
const WORDS = {
  optical: "optical residuals?", ramp: "optical ramp", stretch: "log-stretch", trace_budget: "tracing budget", ftle: "FTLE", t0: "t0", tau: "tau", window: "window",
  slide: "slides?", tolerance: "tolerance", extinction: "extinction", majorant: "majorants?", psnr: "PSNR", trusted: "(?:un)?trusted", surrogate: "surrogate",
};
const ANY = Object.entries(WORDS).map(([term, words]) => `(?<${term}>${words})`).join("|");
const TERM = new RegExp(`(?<![\\w./\`-])(?:${ANY})(?![\\w/\`-]|\\.\\w)`, "gi");

const MARGIN = 8;

/** A button that explains a term. */
export function termButton(term, text) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", className: "term", textContent: text });
  button.dataset.term = term;
  button.setAttribute("aria-describedby", "tip");
  return button;
}

/** Parts of a message, in order: strings, and `{ term, text }` where a term is used for the first time. */
export function partsOf(message) {
  const [parts, seen] = [[], new Set()];
  let end = 0;
  for (const { 0: text, index, groups } of message.matchAll(TERM)) {
    const term = Object.keys(groups).find((name) => groups[name] !== undefined);
    if (seen.has(term)) continue;
    seen.add(term);
    parts.push(message.slice(end, index), { term, text });
    end = index + text.length;
  }
  return [...parts, message.slice(end)].filter((part) => part !== "");
}

/** Nodes of a message, in which terms are explained. */
export const explained = (message) => partsOf(message).map((part) => (typeof part === "string" ? document.createTextNode(part) : termButton(part.term, part.text)));

function place(tip, anchor) {
  const box = anchor.getBoundingClientRect();
  const left = Math.min(box.left, innerWidth - tip.offsetWidth - MARGIN);
  const below = box.bottom + MARGIN;
  const top = below + tip.offsetHeight < innerHeight ? below : box.top - tip.offsetHeight - MARGIN;
  tip.style.left = `${Math.max(MARGIN, left)}px`;
  tip.style.top = `${Math.max(MARGIN, top)}px`;
}

/** Explains terms in `tip`, and lists them all in `list`. */
export function explainTerms(tip, list) {
  let anchor = null;
  const hide = () => { tip.hidden = true; };
  const show = (event) => {
    // A message that changes under the pointer takes its terms with it.
    if (anchor?.isConnected === false) hide();
    anchor = event.target.closest?.(".term") ?? null;
    if (!anchor) return;
    tip.textContent = TERMS[anchor.dataset.term];
    // In full screen only what is inside that element is drawn.
    (document.fullscreenElement ?? document.body).append(tip);
    tip.hidden = false;
    place(tip, anchor);
  };
  for (const type of ["mouseover", "focusin", "click"]) document.addEventListener(type, show);
  for (const type of ["mouseout", "focusout"]) document.addEventListener(type, (event) => event.target.closest?.(".term") && hide());
  document.addEventListener("keydown", (event) => event.key === "Escape" && hide());
  addEventListener("scroll", hide, { passive: true });
  for (const text of Object.values(TERMS)) {
    const item = document.createElement("li");
    item.textContent = text;
    list.append(item);
  }
}
