//! Pictures of media whose radiative transfer is known.

use crate::NEVER;
use ridgewatch::field::{Domain, DomainPoint};
use ridgewatch::render::{CameraSettings, Film, LightSettings, LogStretch, RenderSettings, RenderStats, Renderer, Scene, TransferSettings};

/// A log-stretch field in closed form. Every second point counts as traced.
struct Field<F>(F);

impl<F: Fn([f32; 3]) -> f32> LogStretch for Field<F> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        for (i, point) in points.iter().enumerate() {
            log_stretch[i] = (self.0)(point.0);
            traced[i] = i % 2 == 0;
        }
    }
}

const FOUR_PI: f64 = 4.0 * std::f64::consts::PI;

/// A unit cube that fills the picture in parallel projection along -z. The ramp is the FTLE, the extinction at most 5, the albedo 0.8.
/// A radiance of 4 pi makes the phase function 1.
fn scene(width: usize, light: LightSettings) -> Scene {
    Scene {
        camera: CameraSettings {
            eye: [0.5, 0.5, 1.5],
            look_at: [0.5, 0.5, 1.0],
            up: [0.0, 1.0, 0.0],
            field_of_view: 90.0,
            orthographic: true,
        },
        light,
        transfer: TransferSettings {
            low: Some(0.0),
            high: Some(1.0),
            extinction: Some(5.0),
            albedo: [vec![0.8], vec![0.4], vec![0.0, 0.1]],
        },
        settings: RenderSettings {
            width,
            height: width,
            background: [1.0, 0.5, 0.0],
            majorant_cells: Some([4, 4, 4]),
            ..RenderSettings::default()
        },
        seed: 11,
        scale: [1.0; 3],
        plane: None,
    }
}

fn cube() -> Domain {
    Domain::cuboid([0.0; 3], [1.0; 3])
}

/// Renders `frames` frames of 256 samples with tau = 2 (the field gives FTLE), and merges them.
fn picture(scene: Scene, frames: u64, ftle: impl Fn([f32; 3]) -> f32) -> (Film, Vec<RenderStats>) {
    let mut renderer = Renderer::new(scene, &cube(), 2.0).unwrap();
    let mut answers = Field(|p| 2.0 * ftle(p));
    let (mut merged, mut stats) = renderer.render(0, &mut answers, 256, None, &NEVER).map(|(film, first)| (film, vec![first])).unwrap();
    for frame in 1..frames {
        let (film, next) = renderer.render(frame, &mut answers, 256, None, &NEVER).unwrap();
        merged.accumulate(&film).unwrap();
        stats.push(next);
    }
    (merged, stats)
}

/// Mean of a channel over some pixels and its standard error, from the spread of the pixels.
fn mean(film: &Film, channel: usize, pixels: impl Iterator<Item = usize>) -> (f64, f64) {
    let values: Vec<f64> = pixels.map(|i| f64::from(film.rgba[i][channel])).collect();
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

/// Midpoint rule; 4000 points leave errors below 1e-7 for the smooth integrands here.
fn integral(from: f64, to: f64, f: impl Fn(f64) -> f64) -> f64 {
    let n = 4000;
    let h = (to - from) / f64::from(n);
    (0..n).map(|i| h * f(from + (f64::from(i) + 0.5) * h)).sum()
}

/// Light along the view.
fn from_the_camera() -> LightSettings {
    LightSettings::directional([0.0, 0.0, -1.0], FOUR_PI)
}

fn within(what: &str, (found, error): (f64, f64), expected: f64) {
    assert!(error > 0.0 && (found - expected).abs() < 4.0 * error, "{what}: {found} +- {error}, expected {expected}");
}

#[test]
fn homogeneous_medium_lit_from_the_camera() {
    // FTLE 0.4: extinction 2.
    let (film, stats) = picture(scene(16, from_the_camera()), 4, |_| 0.4);
    let escaped = (-2.0_f64).exp();
    within("alpha", mean(&film, 3, 0..256), 1.0 - escaped);
    let scattered = 0.5 * (1.0 - (-4.0_f64).exp());
    within("red", mean(&film, 0, 0..256), 0.8 * scattered + escaped);
    within("green", mean(&film, 1, 0..256), 0.4 * scattered + 0.5 * escaped);
    // t = 1 - ramp = 0.6.
    within("blue", mean(&film, 2, 0..256), 0.06 * scattered);
    assert!(film.ftle_mean.iter().all(|f| (f - 0.4).abs() < 1e-5), "one value everywhere, up to f32 rounding");
    assert!(film.samples.iter().all(|&s| s == 1024.0));
    // Stated variance against the spread of the 256 pixels: the relative deviation is sqrt(2/255) = 0.09, of which four are accepted.
    let stated = film.variance.iter().map(|&v| f64::from(v)).sum::<f64>() / 256.0;
    let luminance: Vec<f64> =
        film.rgba.iter().map(|p| 0.2126 * f64::from(p[0]) + 0.7152 * f64::from(p[1]) + 0.0722 * f64::from(p[2])).collect();
    let average = luminance.iter().sum::<f64>() / 256.0;
    let spread = luminance.iter().map(|l| (l - average).powi(2)).sum::<f64>() / 255.0;
    assert!((stated / spread - 1.0).abs() < 0.36, "stated {stated}, spread {spread}");
    assert!(stats[3].queries < stats[0].queries * 7 / 10, "majorants 5 tighten toward 2: {stats:?}");
    assert_eq!(stats.iter().map(|s| s.majorant_exceeded).sum::<u64>(), 0);
    assert!(stats.iter().all(|s| s.paths == 65_536 && s.traced * 2 >= s.queries - s.waves && s.traced * 2 <= s.queries + s.waves));
}

#[test]
fn homogeneous_medium_lit_from_the_side() {
    // Photons fly along -x: the path to the light is 1 - x long. Columns of the picture are x.
    let width = 8;
    let (film, _) = picture(scene(width, LightSettings::directional([-3.0, 0.0, 0.0], FOUR_PI)), 8, |_| 0.4);
    for column in 0..width {
        let (left, right) = (column as f64 / width as f64, (column + 1) as f64 / width as f64);
        let lit = integral(left, right, |x| (-2.0 * (1.0 - x)).exp()) * width as f64;
        let expected = 0.8 * lit * (1.0 - (-2.0_f64).exp()) + (-2.0_f64).exp();
        within(&format!("column {column}"), mean(&film, 0, (0..width).map(|row| row * width + column)), expected);
    }
}

#[test]
fn point_light_falls_off_and_ends_the_shadow() {
    // Light inside the medium at the centre of the box; columns at the middle rows against a three-fold quadrature.
    let light = LightSettings { direction: None, position: Some([0.5, 0.5, 3.0]), radiance: [FOUR_PI * 4.0; 3] };
    let (film, _) = picture(scene(8, light), 8, |_| 0.2);
    let n = 64;
    let mut expected = 0.0;
    for k in 0..n * n * n {
        let at = |i: i32| (f64::from(i) + 0.5) / f64::from(n);
        let (x, y, z) = (at(k % n), at(k / n % n), at(k / n / n));
        let offset = [0.5 - x, 0.5 - y, 3.0 - z];
        let squared: f64 = offset.iter().map(|o| o * o).sum();
        // Length of the way to the light inside the box, which it leaves through z = 1.
        let inside = squared.sqrt() * (1.0 - z) / offset[2];
        expected += (-(1.0 - z)).exp() * 4.0 / squared * (-inside).exp();
    }
    expected *= 0.8 / f64::from(n * n * n);
    within("whole picture", mean(&film, 0, 0..64), expected + (-1.0_f64).exp());
}

#[test]
fn ramp_along_the_view_against_quadrature() {
    // FTLE = z: extinction 5 z; optical depth from the top (z = 1) down to z is 2.5 (1 - z^2). Light from above, tilted to the
    // side in y by 45 degrees in a medium that only depends on z, away from the walls.
    let tilt = std::f64::consts::FRAC_1_SQRT_2;
    let mut tilted = scene(16, LightSettings::directional([0.0, tilt, -tilt], FOUR_PI));
    tilted.camera.field_of_view = 2.0 * 0.2_f64.atan().to_degrees();
    tilted.camera.eye[1] = 0.0;
    tilted.camera.look_at[1] = 0.0;
    // The domain is so wide in y that the shadows of rays at y near 0 leave through the top.
    let domain = Domain::cuboid([0.0, -4.0, 0.0], [1.0, 4.0, 1.0]);
    let mut renderer = Renderer::new(tilted, &domain, 1.0).unwrap();
    let mut merged = Film::new(16, 16);
    for frame in 0..4 {
        let (film, _) = renderer.render(frame, &mut Field(|p: [f32; 3]| p[2]), 256, None, &NEVER).unwrap();
        merged.accumulate(&film).unwrap();
    }
    let depth = |z: f64| 2.5 * (1.0 - z * z);
    let escaped = (-depth(0.0)).exp();
    within("alpha", mean(&merged, 3, 0..256), 1.0 - escaped);
    let scattered = integral(0.0, 1.0, |z| 5.0 * z * (-depth(z)).exp() * (-depth(z) / tilt).exp());
    within("red", mean(&merged, 0, 0..256), 0.8 * scattered + escaped);
    // Mean FTLE at collisions: the first moment of the same density.
    let first = integral(0.0, 1.0, |z| 5.0 * z * z * (-depth(z)).exp()) / (1.0 - escaped);
    let ftle = merged.ftle_mean.iter().map(|&f| f64::from(f)).sum::<f64>() / 256.0;
    // Deviation of one collision is below 0.3; 262,144 paths.
    assert!((ftle - first).abs() < 4.0 * 0.3 / 512.0, "{ftle} {first}");
}

#[test]
fn a_majorant_that_learned_too_little_stays_unbiased_and_is_raised() {
    // The first frame sees a thin medium, then the field changes without notice: like a thin ridge that no sample has met.
    let mut renderer = Renderer::new(scene(16, from_the_camera()), &cube(), 1.0).unwrap();
    for frame in 0..2 {
        renderer.render(frame, &mut Field(|_| 0.28), 256, None, &NEVER).unwrap();
    }
    let (film, stats) = renderer.render(2, &mut Field(|_| 0.4), 256, None, &NEVER).unwrap();
    // Majorants of 5 (1.1 * 0.28 + 0.02) and a little for an extinction of 2. Four of five paths collide; each meets what it did not expect once.
    let exceeded = stats.majorant_exceeded as f64 / stats.paths as f64;
    assert!((exceeded - (1.0 - (-1.64_f64).exp())).abs() < 0.02, "{stats:?}");
    let escaped = (-2.0_f64).exp();
    within("alpha", mean(&film, 3, 0..256), 1.0 - escaped);
    within("red", mean(&film, 0, 0..256), 0.4 * (1.0 - (-4.0_f64).exp()) + escaped);
    let (_, stats) = renderer.render(3, &mut Field(|_| 0.4), 256, None, &NEVER).unwrap();
    assert_eq!(stats.majorant_exceeded, 0, "later frames have learned it");
}

#[test]
fn missing_values_are_empty_and_shown_as_land() {
    // Land at x < 0.5, and empty sea beyond it.
    let land = |p: [f32; 3]| if p[0] < 0.5 { f32::NAN } else { -1.0 };
    let mut map = scene(16, from_the_camera());
    map.settings.missing_color = [0.25; 3];
    map.transfer.extinction = Some(20.0);
    let (film, stats) = picture(map, 4, land);
    for (i, pixel) in film.rgba.iter().enumerate() {
        if i % 16 < 8 {
            assert_eq!((*pixel, film.missing[i]), ([0.25, 0.25, 0.25, 0.0], 1.0), "land");
        } else {
            assert_eq!((*pixel, film.missing[i]), ([1.0, 0.5, 0.0, 0.0], 0.0), "background, untouched");
        }
        assert!(film.ftle_mean[i].is_nan());
    }
    assert!(stats[0].missing > 0 && stats[0].missing < stats[0].queries);
}

#[test]
fn land_casts_no_shadow() {
    // Missing values above z = 0.5, medium below: transmittance is that of the lower half.
    let (film, _) = picture(scene(16, from_the_camera()), 4, |p| if p[2] > 0.5 { f32::NAN } else { 0.4 });
    within("alpha", mean(&film, 3, 0..256), 1.0 - (-1.0_f64).exp());
    // A path without collision samples its way, half of which is missing. Blue has no background.
    within("blue", mean(&film, 2, 0..256), 0.06 * 0.5 * (1.0 - (-2.0_f64).exp()) + 0.3 * 0.5 * (-1.0_f64).exp());
}
