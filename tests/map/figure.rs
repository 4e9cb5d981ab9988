//! `ridgewatch figure`: pages of a small run, and refused folders.

use crate::kit::program::{config, records, ridgewatch, run, text};
use crate::kit::scene::{double_gyre, parse, run_frames, setup};
use ridgewatch::map::number;
use ridgewatch::run::{ColorBar, RunOptions};
use std::path::Path;

/// A run of two slides and three frames, of which the pictures of the newest two are kept.
fn small_run(out: &Path) {
    let gyre = config("double_gyre.toml");
    let keys = [
        "time.tau=5",
        "time.slides=2",
        "time.frames_per_slide=2",
        "time.warmup_frames=0",
        "render.width=96",
        "render.height=48",
        "publish.keep=2",
    ];
    let mut all = vec!["replay", &gyre, "--device", "cpu", "--out", text(out)];
    keys.iter().for_each(|key| all.extend(["--set", key]));
    run(&mut ridgewatch(all)).success();
}

/// All texts of an SVG, with spaces between them.
fn words(svg: &Path) -> String {
    let source = std::fs::read_to_string(svg).unwrap();
    let document = roxmltree::Document::parse(&source).unwrap();
    let texts = document.descendants().filter(|n| n.has_tag_name("text")).map(|n| n.text().unwrap_or_default().trim().to_owned());
    texts.collect::<Vec<_>>().join(" ")
}

#[test]
fn a_page_says_what_the_frame_shows_and_how_wrong_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let [gyre, svg, png] = ["gyre", "page.svg", "page.png"].map(|name| folder.path().join(name));
    small_run(&gyre);
    let report = run(&mut ridgewatch(["figure", text(&gyre), "--out", text(&svg), "--json"])).success().json();
    let records = records(&gyre);
    let newest = records.last().unwrap();
    assert_eq!(report["frame"], newest.frame);
    let words = words(&svg);
    let error = newest.picture_error.unwrap();
    let share = |decibels: f64| number(100.0 * 10f64.powf(-decibels / 20.0));
    for part in [
        "Double gyre, sliding",
        "tau = 5 forward",
        &format!("frame {}", newest.frame),
        "forward FTLE (repelling structures)",
        "Source: closed form: double_gyre.",
        "Extent: x 0 to 2, y 0 to 1.",
        "Method: two_level with surrogate table",
        &format!("Error of colours: {} % rms", share(error.psnr.value)),
        &format!("{:.1} dB [{:.1}, {:.1}]", error.psnr.value, error.psnr.low, error.psnr.high),
        &format!("FTLE traced with {} steps", newest.integration_steps.unwrap()),
        &format!("ridgewatch {}", env!("CARGO_PKG_VERSION")),
    ] {
        assert!(words.contains(part), "{part:?} is not in {words}");
    }
    // The picture is inside as it was kept.
    let source = std::fs::read_to_string(&svg).unwrap();
    let document = roxmltree::Document::parse(&source).unwrap();
    let image = document.descendants().find(|n| n.has_tag_name("image")).unwrap();
    let href = image.attribute("href").unwrap().strip_prefix("data:image/png;base64,").unwrap();
    let inside =
        image::load_from_memory(&base64::Engine::decode(&base64::engine::general_purpose::STANDARD, href).unwrap()).unwrap().to_rgb8();
    let kept = image::open(gyre.join(format!("frames/frame_{:06}.png", newest.frame))).unwrap().to_rgb8();
    assert_eq!(inside, kept);
    // As PNG, of an earlier frame.
    let earlier = (newest.frame - 1).to_string();
    run(&mut ridgewatch(["figure", text(&gyre), "--frame", &earlier, "--width", "640", "--out", text(&png)])).success();
    let page = image::open(&png).unwrap().to_rgb8();
    assert!(page.width() == 640 && page.height() > 400 && *page.get_pixel(0, 0) == image::Rgb([255; 3]));
    // A frame of which only the EXR is kept is tone-mapped as it was.
    std::fs::remove_file(gyre.join(format!("frames/frame_{:06}.png", newest.frame))).unwrap();
    let from_exr = folder.path().join("exr.svg");
    run(&mut ridgewatch(["figure", text(&gyre), "--out", text(&from_exr)])).success();
    assert_eq!(std::fs::read_to_string(from_exr).unwrap(), source);
}

#[test]
fn colours_follow_from_record_and_scene() {
    let scene = double_gyre(
        [24, 12, 2],
        "time.tau = 4.0\ntime.slides = 1\ntransfer.albedo = \"published\"\nrender.method = \"two_level\"\nsurrogate.kind = \"table\"",
    );
    let settings = parse(&scene, &[]).unwrap().settings();
    let mut frames = 0;
    run_frames(setup(&scene, &[]), &RunOptions::default(), |frame| {
        assert_eq!(&ColorBar::of(&settings, &frame.record).unwrap(), frame.color_bar.as_deref().unwrap());
        frames += 1;
    });
    assert!(frames > 0);
}

#[test]
fn what_is_no_run_or_was_dropped_is_refused_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let gyre = folder.path().join("gyre");
    small_run(&gyre);
    let elsewhere = folder.path().join("elsewhere");
    std::fs::create_dir(&elsewhere).unwrap();
    let figure = |arguments: &[&str], status: i32, parts: &[&str]| {
        let all: Vec<&str> = ["figure"].into_iter().chain(arguments.iter().copied()).collect();
        run(ridgewatch(all).current_dir(&elsewhere)).refused(status, parts);
        assert!(!elsewhere.join("out/figure.png").exists());
    };
    figure(&[text(&elsewhere)], 1, &["elsewhere", "is no run", "records.jsonl"]);
    figure(&[text(&gyre), "--frame", "0"], 2, &["--frame 0", "accepted: 2 to 3"]);
    figure(&[text(&gyre), "--out", "page.gif"], 2, &["--out page.gif", ".png or .svg"]);
    // The record of another version, and none.
    let (path, text_of) =
        (gyre.join("records.jsonl"), |from: &str, to: &str| std::fs::read_to_string(gyre.join("records.jsonl")).unwrap().replace(from, to));
    std::fs::write(&path, text_of("\"domain\":{", "\"other\":{")).unwrap();
    figure(&[text(&gyre)], 1, &["the record of frame 3 lacks `camera` or `domain`", "repeats the run"]);
    std::fs::write(&path, text_of("\"frame\":3,", "\"frame\":7,")).unwrap();
    figure(&[text(&gyre)], 1, &["no record of frame 3"]);
    std::fs::remove_dir_all(gyre.join("frames")).unwrap();
    figure(&[text(&gyre)], 1, &["keeps no pictures"]);
}
