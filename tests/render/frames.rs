//! Frames of the renderer: equal on every machine, merging, stopping, bad scenes, the reference scene.

use crate::NEVER;
use ridgewatch::field::analytic::Analytic;
use ridgewatch::field::{Domain, DomainPoint};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::render::{CameraSettings, Film, LightSettings, LogStretch, RenderError, RenderSettings, Renderer, Scene, TransferSettings};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// The published double gyre, traced from t = 0 by tangent flow; a particle that leaves the open box has FTLE 0.
struct DoubleGyre(Box<dyn Tracer>);

impl DoubleGyre {
    fn new(tau: f64, steps: usize) -> Self {
        let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 0.2 * std::f64::consts::PI };
        let map = FlowMap { boundary: Boundary::Zero, ..FlowMap::tangent(tau, steps) };
        Self(cpu_tracer(VelocitySource::Analytic(flow, gyre_box()), &map, 0.0).unwrap())
    }
}

impl LogStretch for DoubleGyre {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        let mut out = Traced::default();
        self.0.trace(points, Extras::default(), &mut out);
        log_stretch.copy_from_slice(&out.log_stretch);
        traced.fill(true);
    }
}

/// A cheap field with structure, partly missing, partly traced.
struct Waves;

impl LogStretch for Waves {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        for (i, p) in points.iter().enumerate() {
            let value = (7.0 * p.0[0] + 3.0 * p.0[2]).sin() * (9.0 * p.0[1]).cos();
            log_stretch[i] = if p.0[0] > 1.8 && p.0[1] < 0.3 { f32::NAN } else { value };
            traced[i] = p.0[1] > 0.5;
        }
    }
}

/// The scene of the published small renderer, exactly.
fn published(width: usize, height: usize) -> Scene {
    let settings = RenderSettings { width, height, background: [1.0; 3], tone_map: [1.85, 0.75, 1.4], ..RenderSettings::default() };
    let camera =
        CameraSettings { eye: [1.0, 0.5, 2.3], look_at: [1.0, 0.5, 0.5], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: false };
    let light = LightSettings { direction: Some([-1.0, -1.0, -1.0]), position: None, radiance: [12.0; 3] };
    let transfer = TransferSettings { low: Some(0.05), high: Some(0.235), extinction: Some(100.0), ..TransferSettings::default() };
    Scene::assemble(&gyre_box(), Some(camera), Some(light), Some(transfer), settings, 1)
}

fn gyre_box() -> Domain {
    Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0))
}

/// Scene for [`Waves`] (tau 1).
fn waves(width: usize, height: usize) -> Scene {
    let mut scene = published(width, height);
    scene.transfer = TransferSettings { low: Some(0.2), high: Some(0.9), extinction: Some(20.0), ..TransferSettings::default() };
    scene
}

/// Films hold NaN where nothing was hit, so bits are compared.
fn bits(film: &Film) -> Vec<u32> {
    let rgba = film.rgba.iter().flatten();
    let rest = [&film.ftle_mean, &film.traced, &film.variance, &film.samples, &film.missing, &film.queries];
    rgba.chain(rest.into_iter().flatten()).map(|v| v.to_bits()).collect()
}

#[test]
fn threads_and_wave_sizes_leave_every_bit_alone() {
    let render = |threads: usize, flights: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut renderer = Renderer::new(waves(37, 23), &gyre_box(), 1.0).unwrap().with_wave_flights(flights);
            // Three frames, so that majorants have tightened.
            (0..3).map(|frame| bits(&renderer.render(frame, &mut Waves, 9, None, &NEVER).unwrap().0)).collect::<Vec<_>>()
        })
    };
    let reference = render(1, 1 << 17);
    assert!(reference[0] != reference[1], "frames draw different numbers");
    for (threads, flights) in [(2, 1 << 17), (8, 1 << 17), (1, 1000), (8, 3000), (2, 7)] {
        assert!(render(threads, flights) == reference, "{threads} threads, {flights} flights");
    }
}

#[test]
fn passes_merge_to_the_film_of_one_go() {
    let domain = gyre_box();
    let mut renderer = Renderer::new(waves(24, 12), &domain, 1.0).unwrap();
    renderer.render(0, &mut Waves, 8, None, &NEVER).unwrap();
    let (whole, stats) = renderer.render(1, &mut Waves, 24, None, &NEVER).unwrap();
    let mut merged = Film::new(24, 12);
    let mut queries = 0;
    for part in [16..24, 0..1, 1..16] {
        let (film, stats) = renderer.render_samples(1, part, &mut Waves, None, &NEVER).unwrap();
        merged.accumulate(&film).unwrap();
        queries += stats.queries;
    }
    assert_eq!(queries, stats.queries, "the same majorants, so the same paths");
    assert_eq!((&merged.samples, &merged.queries), (&whole.samples, &whole.queries));
    let near = |a: f32, b: f32| (a.is_nan() && b.is_nan()) || (a - b).abs() <= 2e-6 * (1.0 + b.abs());
    for i in 0..whole.rgba.len() {
        // f32 means of means of numbers up to 1.
        assert!((0..4).all(|k| near(merged.rgba[i][k], whole.rgba[i][k])));
        assert!(near(merged.variance[i], whole.variance[i]) && near(merged.missing[i], whole.missing[i]));
        assert!(near(merged.ftle_mean[i], whole.ftle_mean[i]) && near(merged.traced[i], whole.traced[i]));
    }
}

#[test]
fn a_frame_stops_when_asked_and_says_how_far_it_is() {
    let mut renderer = Renderer::new(waves(64, 64), &gyre_box(), 1.0).unwrap().with_wave_flights(512);
    let stop = AtomicBool::new(false);
    let heard = Mutex::new(Vec::new());
    let progress = |share: f32| {
        let mut heard = heard.lock().unwrap();
        heard.push(share);
        if share > 0.3 {
            stop.store(true, Ordering::Relaxed);
        }
    };
    let (film, stats) = renderer.render(0, &mut Waves, 16, Some(&progress), &stop).unwrap();
    assert!(stats.stopped);
    let done = film.samples.iter().filter(|&&s| s == 16.0).count();
    let open = film.samples.iter().filter(|&&s| s == 0.0).count();
    assert!(done > 64 * 64 / 5 && open > 64 * 64 / 3 && done + open == 64 * 64, "{done} done, {open} open");
    let heard = heard.into_inner().unwrap();
    assert!(heard.windows(2).all(|w| w[0] <= w[1]));

    let last = Mutex::new(0.0);
    let (_, stats) = renderer.render(1, &mut Waves, 2, Some(&|share| *last.lock().unwrap() = share), &NEVER).unwrap();
    assert!(!stats.stopped && *last.lock().unwrap() == 1.0);
}

#[test]
fn a_scene_can_be_edited_between_frames() {
    let mut renderer = Renderer::new(waves(32, 16), &gyre_box(), 1.0).unwrap();
    let first = renderer.render(0, &mut Waves, 64, None, &NEVER).unwrap().1.queries;
    let mut scene = renderer.scene().clone();
    scene.settings.width = 0;
    assert!(renderer.set_scene(scene).is_err());
    assert_eq!(renderer.scene().settings.width, 32, "a refused edit changes nothing");
    let mut scene = renderer.scene().clone();
    scene.transfer.extinction = Some(10.0);
    renderer.set_scene(scene).unwrap();
    let (film, stats) = renderer.render(1, &mut Waves, 64, None, &NEVER).unwrap();
    assert!(stats.queries < first && stats.majorant_exceeded < stats.queries / 200, "re-derived, not forgotten: {stats:?} after {first}");
    // The same frame from scratch: means agree within noise (alpha is 0 or 1 a path: deviation at most 0.5; 32,768 paths each).
    let mut fresh = Renderer::new(renderer.scene().clone(), &gyre_box(), 1.0).unwrap();
    let (other, _) = fresh.render(7, &mut Waves, 64, None, &NEVER).unwrap();
    let alpha = |film: &Film| film.rgba.iter().map(|p| f64::from(p[3])).sum::<f64>() / film.rgba.len() as f64;
    assert!((alpha(&film) - alpha(&other)).abs() < 4.0 * 0.5 * (2.0 / 32_768.0_f64).sqrt());
}

#[test]
fn values_known_from_elsewhere_tighten_the_first_frame() {
    let first_frame = |informed: bool| {
        let mut renderer = Renderer::new(waves(32, 16), &gyre_box(), 1.0).unwrap();
        if informed {
            // A table of 200x100x10 nodes.
            let place = |i: usize| DomainPoint([(i % 200) as f32 / 100.0, (i / 200 % 100) as f32 / 100.0, (i / 20_000) as f32 / 10.0]);
            let points: Vec<DomainPoint> = (0..200_000).map(place).collect();
            let (mut log_stretch, mut traced) = (vec![0.0; points.len()], vec![false; points.len()]);
            Waves.evaluate(&points, &mut log_stretch, &mut traced);
            renderer.observe(&points, &log_stretch);
        }
        renderer.render(0, &mut Waves, 16, None, &NEVER).unwrap().1
    };
    let (informed, blind) = (first_frame(true), first_frame(false));
    assert!(informed.queries * 3 < blind.queries * 2, "{informed:?} against {blind:?}");
    assert!(informed.majorant_exceeded * 200 < informed.queries, "{informed:?}");
}

#[test]
fn tight_and_loose_majorants_draw_the_same_picture() {
    // Late frames of one renderer, with learned majorants, against first frames of new renderers.
    let mut learned = Renderer::new(waves(16, 8), &gyre_box(), 1.0).unwrap();
    let (mut tight, mut loose) = (Film::new(16, 8), Film::new(16, 8));
    let mut exceeded = 0;
    for frame in 0..40 {
        let (film, stats) = learned.render(frame, &mut Waves, 64, None, &NEVER).unwrap();
        if frame >= 3 {
            tight.accumulate(&film).unwrap();
            exceeded += stats.majorant_exceeded;
        }
        let mut fresh = Renderer::new(waves(16, 8), &gyre_box(), 1.0).unwrap();
        loose.accumulate(&fresh.render(100 + frame, &mut Waves, 64, None, &NEVER).unwrap().0).unwrap();
    }
    // Per pixel, differences over their stated deviation are standard normal: their mean square over 128 pixels is 1 +- sqrt(2/128).
    let mut squares = 0.0;
    for i in 0..128 {
        let luminance = |p: [f32; 4]| 0.2126 * f64::from(p[0]) + 0.7152 * f64::from(p[1]) + 0.0722 * f64::from(p[2]);
        let variance = f64::from(tight.variance[i]) + f64::from(loose.variance[i]);
        if variance > 0.0 {
            squares += (luminance(tight.rgba[i]) - luminance(loose.rgba[i])).powi(2) / variance / 128.0;
        }
    }
    assert!(squares < 1.0 + 4.0 * 0.125, "mean square {squares}, {exceeded} above their majorant");
}

#[test]
fn bad_scenes_name_the_key() {
    let fault = |edit: fn(&mut Scene)| {
        let mut scene = published(200, 100);
        edit(&mut scene);
        Renderer::new(scene, &gyre_box(), 40.0).unwrap_err().to_string()
    };
    assert_eq!(fault(|s| s.settings.width = 0), "`render.width` is 0; accepted: 1 to 16384 pixels");
    assert!(fault(|s| s.settings.height = 20_000).starts_with("`render.height` is 20000"));
    assert!(fault(|s| (s.settings.width, s.settings.height) = (16_384, 16_384)).contains("pixels in all"));
    assert!(fault(|s| s.transfer.extinction = Some(1e9)).starts_with("`transfer.extinction`"));
    assert!(fault(|s| s.settings.samples = 0.0).starts_with("`render.samples` is 0"));
    assert!(fault(|s| s.settings.tone_map[2] = 0.0).starts_with("`render.tone_map`"));
    assert!(fault(|s| s.settings.background[1] = -1.0).starts_with("`render.background`"));
    assert!(fault(|s| s.settings.missing_color[1] = f64::NAN).starts_with("`render.missing_color`"));
    assert!(fault(|s| s.settings.majorant_cells = Some([0, 1, 1])).starts_with("`render.majorant_cells` is [0, 1, 1]"));
    assert!(fault(|s| s.settings.majorant_cells = Some([1024; 3])).contains("in all"));
    assert!(fault(|s| s.camera.look_at = s.camera.eye).starts_with("`camera.look_at`"));
    assert!(fault(|s| s.light.direction = None).starts_with("`light`"));
    assert!(fault(|s| s.transfer.high = Some(0.0)).starts_with("`transfer.high` is 0.0"));
    assert!(fault(|s| s.scale[0] = 0.0).contains("scale"));
    let flat = Domain::cuboid([0.0; 3], [1.0, 0.0, 1.0]);
    assert!(Renderer::new(published(2, 1), &flat, 1.0).unwrap_err().to_string().contains("max above min"));
    assert!(Renderer::new(published(2, 1), &gyre_box(), f64::NAN).unwrap_err().to_string().contains("tau"));
    let mut renderer = Renderer::new(published(2, 1), &gyre_box(), 1.0).unwrap();
    assert!(matches!(renderer.render(0, &mut Waves, 0, None, &NEVER), Err(RenderError::Samples { .. })));
    assert!(matches!(renderer.render(0, &mut Waves, usize::MAX, None, &NEVER), Err(RenderError::Samples { .. })));
}

#[test]
fn bare_files_get_a_view_of_everything() {
    for domain in [
        Domain::slab([-70.0, 20.0], [10.0, 60.0], (0.0, 1.0)),
        Domain::cuboid([0.0, -90.0, 0.0], [359.0, 90.0, 30_000.0]),
        Domain::cuboid([0.0; 3], [0.01, 0.02, 0.04]),
    ] {
        let transfer = TransferSettings { low: Some(0.0), high: Some(1.0), ..TransferSettings::default() };
        let scene = Scene::assemble(&domain, None, None, Some(transfer), RenderSettings { width: 48, height: 24, ..Default::default() }, 0);
        let mut renderer = Renderer::new(scene, &domain, 1.0).unwrap();
        struct Half;
        impl LogStretch for Half {
            fn evaluate(&mut self, _: &[DomainPoint], log_stretch: &mut [f32], _: &mut [bool]) {
                log_stretch.fill(0.5);
            }
        }
        let (film, stats) = renderer.render(0, &mut Half, 8, None, &NEVER).unwrap();
        let seen = film.rgba.iter().filter(|p| p[3] > 0.5).count();
        assert!(seen > 48 * 24 / 8, "{domain:?}: {seen} pixels");
        let edge = |i: usize| film.rgba[i][3] > 0.0;
        if domain.dimensions == 3 {
            let border = (0..48).chain(23 * 48..24 * 48).chain((0..24).map(|y| y * 48)).chain((0..24).map(|y| y * 48 + 47));
            assert_eq!(border.filter(|&i| edge(i)).count(), 0, "the whole box is in view");
        } else {
            assert!((0..48).all(|x| edge(12 * 48 + x)), "a map fills the picture's width");
        }
        assert!(stats.queries > 0);
    }
}

#[test]
fn the_reference_scene_is_sane() {
    // Test size and a shorter window than the published 40, so that the test takes a second: ridges on both sides of the middle,
    // background at the rim, brighter where thin.
    let mut gyre = DoubleGyre::new(10.0, 50);
    let mut renderer = Renderer::new(published(40, 20), &gyre_box(), 10.0).unwrap();
    let (film, stats) = renderer.render(0, &mut gyre, 16, None, &NEVER).unwrap();
    assert!(film.samples.iter().all(|&s| s == 16.0));
    assert_eq!((film.rgba[0][3], film.rgba[0][..3].to_vec()), (0.0, vec![1.0; 3]), "the corner is outside of the box");
    let inside: Vec<_> = (0..800).filter(|i| (5..35).contains(&(i % 40)) && (2..18).contains(&(i / 40))).collect();
    let alpha = inside.iter().map(|&i| film.rgba[i][3]).sum::<f32>() / inside.len() as f32;
    assert!(alpha > 0.8, "an optical depth of 100 hides most of the background: {alpha}");
    assert!(film.rgba.iter().flatten().all(|v| (-0.01..=1.05).contains(v)), "weights are 1 with the majorants of a first frame");
    let ftle: Vec<f32> = inside.iter().map(|&i| film.ftle_mean[i]).filter(|f| f.is_finite()).collect();
    assert!(ftle.iter().all(|f| (0.05..0.6).contains(f)), "collisions happen above the ramp's low end");
    assert_eq!(stats.traced, stats.queries);
    assert_eq!(stats.majorant_exceeded, 0);
}

/// Draws the published picture: `RENDER_PICTURE=out.png cargo test --release --test render -- --ignored`.
#[test]
#[ignore = "draws a picture to look at"]
fn the_reference_scene_in_full() {
    let path = std::env::var("RENDER_PICTURE").expect("RENDER_PICTURE names the file to write");
    let mut gyre = DoubleGyre::new(40.0, 400);
    let scene = published(200, 100);
    let tone_map = scene.settings.tone_map;
    let mut renderer = Renderer::new(scene, &gyre_box(), 40.0).unwrap();
    let mut film = Film::new(200, 100);
    for (frame, samples) in [1, 15, 48].into_iter().enumerate() {
        let (pass, stats) = renderer.render(frame as u64, &mut gyre, samples, None, &NEVER).unwrap();
        film.accumulate(&pass).unwrap();
        eprintln!("{stats:?}");
    }
    image::save_buffer(path, &film.tone_mapped(tone_map), 200, 100, image::ColorType::Rgb8).unwrap();
}
