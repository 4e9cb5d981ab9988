// The view of `LiveFrames` in a notebook: the newest picture, and what its record says. See widget.py.
const DASH = "–";
const percent = (share) => (Number.isFinite(share) ? `${(100 * share).toPrecision(3)} %` : DASH);
const decibels = (value) => (Number.isFinite(value) ? `${value.toFixed(1)} dB` : DASH);

const SURROGATES = { table: "a table", network: "a network", residual: "a table with a network" };

/** What was traced for a picture. Where a surrogate draws it, all that is traced corrects it or measures its error, and a share of it tells nothing. */
function tracedWords({ method, surrogate, traced, traced_share: share, picture_error: error }) {
  const drawn = `drawn by ${SURROGATES[surrogate] ?? "a surrogate"}`;
  if (method === "two_level") return `${drawn} and corrected with ${traced ?? DASH} traced points`;
  if (method === "marched") return `${drawn}, uncorrected: ${traced ?? DASH} traced points only measure its error`;
  return method === "map" ? `${error?.samples_per_pixel?.toFixed(0) ?? DASH} seeds a pixel` : `${percent(share)} traced`;
}

function words(record) {
  const { frame, slide, time, time_unit: unit, date, picture_error: error, device } = record;
  if (frame === undefined) return "";
  // Sums of steps are 0.6000000000000001.
  const when = date ?? `t = ${Number(time?.toPrecision(12))} ${unit ?? ""}`.trim();
  const stated = error ? `error ${percent(error.rms?.value)} rms, ${decibels(error.psnr?.value)}` : "no error stated";
  return `frame ${frame}, slide ${slide}, ${when}; ${stated}; ${tracedWords(record)}; ${device ?? DASH}`;
}

function render({ model, el }) {
  const [picture, line, state] = ["img", "div", "div"].map((name) => el.appendChild(document.createElement(name)));
  picture.style.maxWidth = "100%";
  picture.alt = "newest frame";
  let address = null;

  const draw = async () => {
    const bytes = model.get("picture");
    if (!bytes?.byteLength) return;
    const next = URL.createObjectURL(new Blob([bytes], { type: `image/${model.get("encoding")}` }));
    const { frame } = model.get("record");
    picture.src = next;
    try {
      await picture.decode();
    } catch {
      // A newer picture interrupts this one.
      if (picture.src === next) line.textContent = `The picture of frame ${frame} cannot be drawn.`;
    }
    if (address !== null) URL.revokeObjectURL(address);
    address = next;
    // The next frame is sent after this, so that none waits on the way.
    model.send({ drawn: frame });
  };
  const tell = () => { line.textContent = words(model.get("record")); };
  const report = () => { state.textContent = model.get("state"); };
  const listeners = [["change:picture", draw], ["change:record", tell], ["change:state", report]];
  for (const [event, act] of listeners) model.on(event, act);
  tell();
  report();
  draw();
  return () => {
    for (const [event, act] of listeners) model.off(event, act);
    if (address !== null) URL.revokeObjectURL(address);
  };
}

export default { render };
