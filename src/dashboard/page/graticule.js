// Where the picture lies: a graticule over a map, the edges of the box around a volume.
import { add, cross, dot, film, halves, subtract, unit } from "./camera.js";
import { ticks } from "./colour_bar.js";
import { isKnown, toDegrees, toScene } from "./projection.js";
import { number } from "./words.js";

// Points nearer to the eye than this share of the distance to what it looks at have no place in the picture.
const NEAR = 1e-3;
const ROUNDING = 1e-6;
const DIGITS = 6;
// Steps of degrees that are in use on maps, and most lines of one kind.
const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 20, 30, 45, 60, 90];
const LINES = 7;
// Parts of a curved line, and of the picture where its places are sought.
const PARTS = 96;
const SOUGHT = 32;

const between = (a, b, share) => add(a, subtract(b, a), share);

/** What a record tells of its view; null if it lacks something, as those of older versions do, or has a projection of a newer one. */
function view({ camera, scale, domain, size, projection = null }) {
  const dimensions = domain?.axes?.length;
  if (!camera || !Array.isArray(scale) || ![2, 3].includes(dimensions) || !(size?.[1] > 0)) return null;
  if (projection !== null && !isKnown(projection)) return null;
  const forward = unit(subtract(camera.look_at, camera.eye));
  return {
    camera, scale, domain, dimensions, forward, projection,
    distance: Math.hypot(...subtract(camera.look_at, camera.eye)),
    film: film(camera), half: halves(camera, size[0] / size[1]),
  };
}

/** Place of a domain point in the picture, in shares of its width and height from the left and the top, and its distance along the view. */
function project({ camera, scale, projection, film: { right, upward }, half: [width, height], forward, distance }, point) {
  const scaled = point.map((value, k) => value * scale[k]);
  const offset = subtract(projection === null ? scaled : [...toScene(projection, point), scaled[2]], camera.eye);
  const depth = dot(offset, forward);
  const shrink = camera.orthographic ? 1 : distance / depth;
  return { x: 0.5 + (0.5 * shrink * dot(offset, right)) / width, y: 0.5 - (0.5 * shrink * dot(offset, upward)) / height, depth };
}

/** Ends in the picture of a line between domain points; null if nothing of it is seen. */
function line(view, a, b) {
  const nearest = view.camera.orthographic ? -Infinity : NEAR * view.distance;
  const [depthA, depthB] = [a, b].map((point) => project(view, point).depth);
  if (depthA < nearest && depthB < nearest) return null;
  // A part behind the eye is cut off, with some room for rounding.
  const cut = (from, to, depthFrom, depthTo) => (depthFrom < nearest ? between(from, to, (nearest * 1.001 - depthFrom) / (depthTo - depthFrom)) : from);
  const [p, q] = [cut(a, b, depthA, depthB), cut(b, a, depthB, depthA)].map((point) => project(view, point));
  // Liang and Barsky 1984.
  let [first, last] = [0, 1];
  for (const [start, move] of [[p.x, q.x - p.x], [p.y, q.y - p.y]]) {
    for (const [room, way] of [[start, -move], [1 - start, move]]) {
      // An edge of the domain may lie on the edge of the picture.
      if (way === 0 && room < -ROUNDING) return null;
      if (way < 0) first = Math.max(first, (room + ROUNDING) / way);
      if (way > 0) last = Math.min(last, (room + ROUNDING) / way);
    }
  }
  const at = (share) => [p.x + share * (q.x - p.x), p.y + share * (q.y - p.y)].map((value) => Math.min(Math.max(value, 0), 1));
  return first < last ? [at(first), at(last)] : null;
}

/** A value of an axis; degrees as 10°E or 35°S. */
export function placeWords(value, unit, digits = DIGITS) {
  if (unit === "degrees_east") {
    const wrapped = ((((value + 180) % 360) + 360) % 360) - 180;
    return `${number(Math.abs(wrapped), digits)}°${wrapped === 0 || wrapped === -180 ? "" : wrapped < 0 ? "W" : "E"}`;
  }
  if (unit === "degrees_north") return `${number(Math.abs(value), digits)}°${value === 0 ? "" : value < 0 ? "S" : "N"}`;
  return number(value, digits).replace(/\.?0+e/, "e");
}

const isDegrees = (unit) => /^degrees_(east|north)$/.test(unit);
const axisWords = ([name, unit]) => (unit && !isDegrees(unit) ? `${name} (${unit})` : name);

/** Where a point of the film (-1 to 1, from the left and the bottom) meets the domain's middle plane, in scene units; null above the horizon. */
function met({ camera, scale, domain: { min, max }, film: { right, upward }, half: [width, height], forward, distance }, [x, y]) {
  const level = (0.5 * (min[2] + max[2])) * scale[2];
  const offset = add(right.map((value) => value * x * width), upward, y * height);
  const [from, along] = camera.orthographic ? [add(camera.eye, offset), forward] : [camera.eye, add(offset, forward, distance)];
  const share = (level - from[2]) / along[2];
  return Number.isFinite(share) && share > 0 ? add(from, along, share) : null;
}

/** Longitudes and latitudes of the domain that the picture shows, with some room: low and high ends of both. */
function seenOnSphere(view) {
  const { projection, domain: { min, max } } = view;
  const films = Array.from({ length: SOUGHT + 1 }, (_, k) => (2 * k) / SOUGHT - 1);
  const places = films.flatMap((x) => films.map((y) => met(view, [x, y]))).filter((point) => point !== null).map((point) => toDegrees(projection, point));
  const slack = [0, 1].map((k) => ROUNDING * (max[k] - min[k]));
  const inside = places.filter((place) => place.every((value, k) => value >= min[k] - slack[k] && value <= max[k] + slack[k]));
  return [0, 1].map((k) => {
    const values = inside.map((place) => place[k]);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const room = (3 * (high - low)) / SOUGHT;
    return [Math.max(min[k], low - room), Math.min(max[k], high + room)];
  });
}

/** The part of the domain's middle plane that the picture shows: low and high ends of x and y. */
function seen(view) {
  const { scale, domain: { min, max } } = view;
  const corners = [[-1, -1], [1, -1], [-1, 1], [1, 1]].map((film) => met(view, film));
  return [0, 1].map((k) => {
    // Above the horizon nothing is met: all of the domain may be seen.
    if (corners.includes(null)) return [min[k], max[k]];
    const ends = corners.map((corner) => corner[k] / scale[k]);
    return [Math.max(min[k], Math.min(...ends)), Math.min(max[k], Math.max(...ends))];
  });
}

/** Values of a graticule of degrees. */
function degreeTicks(low, high) {
  const step = STEPS.find((wide) => (high - low) / wide <= LINES) ?? STEPS.at(-1);
  if (high - low < LINES * STEPS[0]) return ticks(low, high);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.max(0, Math.floor(high / step + 1e-9) - first + 1) }, (_, index) => Number(((first + index) * step).toFixed(1)));
}

/** As many digits as tell neighbours apart, however near the view is. */
const digitsOf = (values) => (values.length < 2 ? DIGITS : Math.max(DIGITS, 1 + Math.ceil(Math.log10(Math.max(...values.map(Math.abs)) / (values[1] - values[0])))));

/** What is seen of a curve through these points: lists of places in the picture. */
function curve(view, points) {
  const pieces = [];
  points.slice(1).forEach((point, index) => {
    const ends = line(view, points[index], point);
    if (ends === null) return;
    const last = pieces.at(-1);
    const goesOn = last !== undefined && Math.hypot(last.at(-1)[0] - ends[0][0], last.at(-1)[1] - ends[0][1]) < ROUNDING;
    if (goesOn) last.push(ends[1]);
    else pieces.push(ends);
  });
  return pieces;
}

/** Meridians and parallels of a map in a projection, as curves. */
function curvedGraticule(view) {
  const { projection, domain: { min, max, axes } } = view;
  const middle = 0.5 * (min[2] + max[2]);
  const ranges = seenOnSphere(view);
  const isPolar = projection.kind === "polar";
  return ranges.flatMap(([low, high], k) => {
    if (!(high > low)) return [];
    const [from, to] = ranges[1 - k];
    // A full circle closes where it began, and a pole is no line.
    const values = degreeTicks(low, high).filter((value, _, all) => (k === 0 ? value - all[0] < 360 : Math.abs(value) < 90));
    const digits = digitsOf(values);
    return values.flatMap((value) => {
      const others = Array.from({ length: PARTS + 1 }, (_, part) => from + ((to - from) * part) / PARTS);
      const pieces = curve(view, others.map((other) => (k === 0 ? [value, other, middle] : [other, value, middle])));
      if (pieces.length === 0) return [];
      // Meridians are named at the bottom, on a polar map at the end that is away from the pole; parallels at the left.
      const all = pieces.flat();
      const outer = projection.pole > 0 ? all[0] : all.at(-1);
      const place = k === 1 ? all.reduce((a, b) => (b[0] < a[0] ? b : a)) : isPolar ? outer : all.reduce((a, b) => (b[1] > a[1] ? b : a));
      const label = { text: placeWords(value, axes[k][1], digits), place, side: k === 0 ? "below" : "left" };
      return pieces.map((points, piece) => ({ points, ends: [points[0], points.at(-1)], hidden: false, labels: piece === 0 ? [label] : [] }));
    });
  });
}

function graticule(view) {
  const { domain: { min, max, axes } } = view;
  const middle = 0.5 * (min[2] + max[2]);
  return seen(view).flatMap(([low, high], k) => {
    if (!(high > low)) return [];
    const values = ticks(low, high);
    const digits = digitsOf(values);
    return values.flatMap((value, index) => {
      const at = (other) => (k === 0 ? [value, other, middle] : [other, value, middle]);
      const ends = line(view, at(min[1 - k]), at(max[1 - k]));
      if (ends === null) return [];
      // Lines of x are named at the bottom, those of y at the left.
      const [a, b] = ends;
      const place = k === 0 ? (a[1] > b[1] ? a : b) : a[0] < b[0] ? a : b;
      // The first of x and the last of y, which do not meet.
      const isNamed = index === (k === 0 ? 0 : values.length - 1) && !isDegrees(axes[k][1]);
      const text = `${isNamed ? `${axisWords(axes[k])} = ` : ""}${placeWords(value, axes[k][1], digits)}`;
      return [{ ends, hidden: false, labels: [{ text, place, side: k === 0 ? "below" : "left" }] }];
    });
  });
}

function box(view) {
  const { camera, scale, forward, domain: { min, max, axes } } = view;
  const corner = (bits) => [0, 1, 2].map((k) => (bits >> k & 1 ? max[k] : min[k]));
  const centre = project(view, between(min, max, 0.5));
  // Of a box around the eye that may lie behind it.
  const middle = centre.depth > 0 ? [centre.x, centre.y] : [0.5, 0.5];
  // A face is seen from its front.
  const isSeen = (axis, end) => {
    const normal = [0, 1, 2].map((k) => (k === axis ? (end ? 1 : -1) : 0));
    const onIt = corner(end << axis).map((value, k) => value * scale[k]);
    return (camera.orthographic ? -dot(normal, forward) : dot(normal, subtract(camera.eye, onIt))) > 0;
  };
  return [0, 1, 2].flatMap((axis) => {
    const [u, v] = [0, 1, 2].filter((k) => k !== axis);
    const edges = [0, 1, 2, 3].flatMap((place) => {
      const start = ((place & 1) << u) | ((place >> 1) << v);
      const faces = [isSeen(u, place & 1), isSeen(v, place >> 1)];
      const corners = [corner(start), corner(start | (1 << axis))];
      const ends = line(view, ...corners);
      return ends === null ? [] : [{ ends, corners, hidden: !faces[0] && !faces[1], rim: faces[0] !== faces[1], labels: [] }];
    });
    // Named is an edge of the outline: the lowest, or the leftmost of the vertical ones.
    const rank = ({ ends: [a, b] }) => (axis === 2 ? a[0] + b[0] : -a[1] - b[1]);
    const outline = edges.filter(({ rim }) => rim);
    const [best] = (outline.length > 0 ? outline : edges).sort((one, other) => rank(one) - rank(other));
    if (best !== undefined) {
      const label = (text, share) => ({ text, place: between(...best.ends, share), side: "outside", of: middle });
      // The name first: where there is no room for all, it stays.
      best.labels = [label(axisWords(axes[axis]), 0.5)];
      for (const [k, share] of [0.06, 0.94].entries()) {
        const { x, y, depth } = project(view, best.corners[k]);
        // Where an edge is cut off it has another value than at its end.
        const isEnd = (camera.orthographic || depth > 0) && Math.hypot(x - best.ends[k][0], y - best.ends[k][1]) < 10 * ROUNDING;
        if (isEnd) best.labels.push(label(placeWords(best.corners[k][axis], axes[axis][1]), share));
      }
    }
    return edges;
  });
}

/** Lines over the picture of a record, with their labels; places are shares of its width and height from the left and the top. A line goes straight between its `ends`, or through `points`. `side` tells where a label stands: `below` at the lower end of a line, `left` at its left end, `outside` beside it, away from `of`. */
export function axesOf(record) {
  const seenFrom = record ? view(record) : null;
  if (seenFrom === null) return [];
  if (seenFrom.projection !== null) return curvedGraticule(seenFrom);
  return seenFrom.dimensions === 2 ? graticule(seenFrom) : box(seenFrom);
}
