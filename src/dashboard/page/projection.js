// The plane of a map of longitudes and latitudes, as the record's `projection` tells it (Snyder, Map projections: a working manual, 1987).

const radians = (degrees) => (degrees * Math.PI) / 180;
const degrees = (angle) => (angle * 180) / Math.PI;
const isometric = (latitude) => Math.log(Math.tan(Math.PI / 4 + radians(latitude) / 2));
const latitudeOf = (value) => degrees(2 * (Math.atan(Math.exp(value)) - Math.PI / 4));

const KINDS = {
  plate_carree: {
    forward: ({ cosine }, [x, y]) => [radians(x) * cosine, radians(y)],
    inverse: ({ cosine }, [x, y]) => [degrees(x / cosine), degrees(y)],
  },
  mercator: {
    forward: (_, [x, y]) => [radians(x), isometric(y)],
    inverse: (_, [x, y]) => [degrees(x), latitudeOf(y)],
  },
  lambert: {
    forward({ middle, n, factor }, [x, y]) {
      const [rho, theta] = [factor * Math.exp(-n * isometric(y)), n * radians(x - middle)];
      return [rho * Math.sin(theta), -rho * Math.cos(theta)];
    },
    inverse({ middle, n, factor }, [x, y]) {
      const sign = Math.sign(n);
      const theta = Math.atan2(sign * x, -sign * y);
      return [middle + degrees(theta / n), latitudeOf(Math.log(factor / (sign * Math.hypot(x, y))) / n)];
    },
  },
  polar: {
    forward({ middle, pole }, [x, y]) {
      const [rho, theta] = [2 * Math.tan(Math.PI / 4 - (pole * radians(y)) / 2), radians(x - middle)];
      return [rho * Math.sin(theta), -pole * rho * Math.cos(theta)];
    },
    inverse({ middle, pole }, [x, y]) {
      return [middle + degrees(Math.atan2(x, -pole * y)), pole * (90 - 2 * degrees(Math.atan(Math.hypot(x, y) / 2)))];
    },
  },
};

/** True if this page knows the projection. */
export const isKnown = (projection) => KINDS[projection?.kind] !== undefined;

/** From degrees to x and y of the scene. */
export function toScene(projection, place) {
  const { unit, origin } = projection;
  return KINDS[projection.kind].forward(projection, place).map((value, k) => origin[k] + unit * value);
}

/** From x and y of the scene to degrees, which may lie nowhere on the globe. */
export function toDegrees(projection, scene) {
  const { unit, origin } = projection;
  return KINDS[projection.kind].inverse(projection, [0, 1].map((k) => (scene[k] - origin[k]) / unit));
}
