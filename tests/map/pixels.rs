//! Pixels against closed forms: the mean over a footprint, and the stated error.

use ridgewatch::backend::Device;
use ridgewatch::field::{Domain, analytic::Analytic};
use ridgewatch::flow::{Boundary, FlowMap, VelocitySource};
use ridgewatch::map::{MapTracer, ProjectionKind, Raster, Sampling, View, contours};

const TAU: f64 = 4.0;

/// The saddle u = x, v = -y in the square of half width 1, whose particles stop at its edge: FTLE = min(1, -ln|x| / tau).
fn stopped_saddle(seeds: usize, seed: u64) -> (View, Raster) {
    let domain = Domain::slab([-1.0; 2], [1.0; 2], (0.0, 1.0));
    let velocity = VelocitySource::Analytic(Analytic::Saddle { rate: 1.0 }, domain.clone());
    let map = FlowMap { boundary: Boundary::Stop, ..FlowMap::tangent(TAU, 2000) };
    let mut tracer = MapTracer::new(&Device::CPU, &velocity, &map, 0.0).unwrap();
    let view = View::new(&domain, false, None, 0.5, 64).unwrap();
    assert_eq!((view.size, view.projection.kind()), ([64, 64], ProjectionKind::Plain));
    let mut done = 0;
    let mut count = |pixels| {
        done += pixels;
        true
    };
    let raster = Raster::trace(&view, &mut tracer, Sampling { seeds, seed }, &mut count).unwrap().unwrap();
    assert_eq!(done, 64 * 64);
    (view, raster)
}

/// Mean of the closed form from a to b, of one sign.
fn mean(a: f64, b: f64) -> f64 {
    let (low, high) = (a.abs().min(b.abs()), a.abs().max(b.abs()));
    let rim = (-TAU).exp();
    // The integral of -ln x is x - x ln x.
    let integral = |x: f64| if x <= rim { x } else { rim + ((x - x * x.ln()) - (rim - rim * rim.ln())) / TAU };
    (integral(high) - integral(low)) / (high - low)
}

#[test]
fn a_pixel_is_the_mean_over_its_footprint_within_the_stated_error() {
    for seeds in [2, 16] {
        let (_, raster) = stopped_saddle(seeds, 7);
        let truth = |pixel: usize| {
            let left = -1.0 + (pixel % 64) as f64 / 32.0;
            mean(left, left + 1.0 / 32.0)
        };
        let square: f64 = raster.mean.iter().enumerate().map(|(pixel, value)| (f64::from(*value) - truth(pixel)).powi(2)).sum();
        let actual = (square / raster.mean.len() as f64).sqrt();
        let stated = raster.error.unwrap();
        println!("{seeds} seeds: error {actual:.2e}, stated {:.2e} ({:.2e} to {:.2e})", stated.rms, stated.interval[0], stated.interval[1]);
        // Halves of one seed are independent and the statement is unbiased. Low-discrepancy halves of eight leave a smaller error, of which that of
        // the steps (2e-4) is a part.
        assert!(actual > 0.8 * stated.rms && actual < 1.2 * stated.rms + 3e-4, "{actual} {stated:?}");
        assert!(stated.interval[0] < stated.rms && stated.rms < stated.interval[1] && stated.pixels == 64 * 64);
        assert!(raster.failed == 0 && raster.missing.iter().all(|share| *share == 0.0));
    }
    // More seeds, smaller error; other random numbers, another picture within it.
    let errors = [2, 16, 64].map(|seeds| stopped_saddle(seeds, 7).1.error.unwrap().rms);
    assert!(errors[1] < 0.35 * errors[0] && errors[2] < 0.5 * errors[1], "{errors:?}");
    let (first, second) = (stopped_saddle(16, 7).1, stopped_saddle(16, 8).1);
    assert!(first.mean != second.mean && first.mean == stopped_saddle(16, 7).1.mean, "the seed decides");
}

#[test]
fn pixels_and_places_agree() {
    let domain = Domain::slab([-25.0, 30.0], [45.0, 72.0], (0.0, 1.0));
    let view = View::new(&domain, true, None, 0.0, 300).unwrap();
    assert_eq!(view.projection.kind(), ProjectionKind::Lambert);
    let mut outside = 0;
    for pixel in 0..view.size[0] * view.size[1] {
        let [x, y] = [(pixel % view.size[0]) as f64 + 0.5, (pixel / view.size[0]) as f64 + 0.5];
        let Some(place) = view.place(x, y) else {
            outside += 1;
            continue;
        };
        let [u, v] = view.pixel(place);
        assert!((u - x).abs() < 1e-6 && (v - y).abs() < 1e-6, "{place:?}");
    }
    // The cone leaves corners empty.
    assert!(outside > 1000 && outside < view.size[0] * view.size[1] / 2, "{outside}");
    assert!(View::new(&domain, false, Some(ProjectionKind::Mercator), 0.0, 300).unwrap_err().contains("accepted: plain"));
}

/// The contour of a linear field is a straight line; that of a cone is a circle, closed.
#[test]
fn contours_lie_on_their_level() {
    let cone: Vec<f32> = (0..60 * 50).map(|k| ((k % 60) as f32 - 30.2).hypot((k / 60) as f32 - 24.7)).collect();
    let lines = contours(&cone, [60, 50], 15.0);
    assert_eq!(lines.len(), 1);
    assert_eq!(lines[0].first(), lines[0].last());
    assert!(lines[0].len() > 80);
    for [x, y] in &lines[0] {
        assert!(((x - 30.2).hypot(y - 24.7) - 15.0).abs() < 0.01, "{x} {y}");
    }
    let mut holed = cone;
    holed[40 * 60 + 30] = f32::NAN;
    let lines = contours(&holed, [60, 50], 15.0);
    assert!(lines.len() == 1 && lines[0].first() != lines[0].last(), "open where a value is missing");
}
