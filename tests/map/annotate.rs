//! `--annotate`: strips below the PNGs of frames.

use crate::kit::program::{config, ridgewatch, run, set, text};
use image::RgbImage;
use ridgewatch::publish::read_exr;
use std::path::Path;

fn replay(out: &Path, width: usize, options: &[&str]) {
    let size = [format!("render.width={width}"), format!("render.height={}", width / 2)];
    let keys = [
        "time.tau=5",
        "time.slides=2",
        "time.frames_per_slide=1",
        "time.warmup_frames=0",
        "render.samples=1",
        // Marching and training go on as time allows, so that two runs of them need not be equal.
        "render.method=gated",
        "surrogate.kind=table",
        "flow.steps=40",
        &size[0],
        &size[1],
    ];
    let gyre = config("double_gyre.toml");
    let all = [&["replay", &gyre, "--device", "cpu", "--out", text(out)][..], &set(&keys), options].concat();
    run(&mut ridgewatch(all)).success();
}

fn picture(run: &Path, frame: usize) -> RgbImage {
    image::open(run.join(format!("frames/frame_{frame:06}.png"))).unwrap().to_rgb8()
}

fn part(image: &RgbImage, from: u32, to: u32) -> RgbImage {
    image::imageops::crop_imm(image, 0, from, image.width(), to - from).to_image()
}

/// Dark pixels, of letters, and coloured ones, of the bar.
fn ink(image: &RgbImage) -> [usize; 2] {
    let spread = |p: &image::Rgb<u8>| p.0.iter().max().unwrap() - p.0.iter().min().unwrap();
    let count = |is: &dyn Fn(&image::Rgb<u8>) -> bool| image.pixels().filter(|p| is(p)).count();
    [count(&|p| p.0.iter().all(|c| *c < 128)), count(&|p| spread(p) > 60)]
}

#[test]
fn a_strip_below_leaves_the_frame_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let [plain, annotated] = ["plain", "annotated"].map(|name| folder.path().join(name));
    replay(&plain, 336, &[]);
    replay(&annotated, 336, &["--annotate"]);
    let mut strips = Vec::new();
    for frame in 0..2 {
        let (alone, with) = (picture(&plain, frame), picture(&annotated, frame));
        assert_eq!((alone.dimensions(), with.width()), ((336, 168), 336));
        assert!(part(&with, 0, 168) == alone, "the picture itself, pixel by pixel");
        // A colour bar and at least three lines of text, each of 12 pixels.
        let strip = part(&with, 168, with.height());
        assert!((80..300).contains(&strip.height()), "{}", strip.height());
        let below_bar = part(&strip, 60, strip.height());
        let ([dark, _], [letters, _], [_, coloured]) = (ink(&strip), ink(&below_bar), ink(&part(&strip, 0, 60)));
        assert!(letters > 300 && dark > letters && coloured > 500, "{letters} {dark} {coloured}");
        strips.push(strip);
        let [a, b] = [&plain, &annotated].map(|run| read_exr(&run.join(format!("frames/frame_{frame:06}.exr"))).unwrap());
        assert!(a.rgba == b.rgba && a.width == 336, "the EXR is the same");
    }
    assert!(strips[0] != strips[1], "each says its own time");
    // Pages show the frame without its strip.
    let pages = [&plain, &annotated].map(|from| {
        let out = folder.path().join("page.png");
        run(&mut ridgewatch(["figure", text(from), "--frame", "1", "--out", text(&out)])).success();
        std::fs::read(out).unwrap()
    });
    assert!(pages[0] == pages[1], "a page of the strip");
}

#[test]
fn narrow_frames_have_room_for_words_and_render_has_a_strip_too() {
    let folder = tempfile::tempdir().unwrap();
    let [plain, annotated] = ["plain", "annotated"].map(|name| folder.path().join(name));
    replay(&plain, 96, &[]);
    replay(&annotated, 96, &["--annotate"]);
    let (alone, with) = (picture(&plain, 0), picture(&annotated, 0));
    assert_eq!((alone.dimensions(), with.width()), ((96, 48), 320));
    assert!(image::imageops::crop_imm(&with, 0, 0, 96, 48).to_image() == alone);
    let beside = image::imageops::crop_imm(&with, 96, 0, 224, 48).to_image();
    assert!(beside.pixels().all(|p| p.0 == [255; 3]), "white");

    let [out, bare] = ["strip.exr", "bare.png"].map(|name| folder.path().join(name));
    let keys = set(&["render.width=336", "render.height=168", "flow.steps=40", "time.tau=5", "render.samples=1"]);
    let gyre = config("double_gyre.toml");
    for (out, options) in [(&out, &["--annotate"][..]), (&bare, &[])] {
        let all = [&["render", gyre.as_str(), "--device", "cpu", "--out", text(out)][..], &keys, options].concat();
        run(&mut ridgewatch(all)).success();
    }
    let [strip, bare] = [out.with_extension("png"), bare].map(|path| image::open(path).unwrap().to_rgb8());
    assert_eq!(bare.dimensions(), (336, 168));
    assert!(strip.height() > 250 && part(&strip, 0, 168) == bare);
}
