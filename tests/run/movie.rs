//! `--movie`: films of a run, compared with its pictures.

use crate::kit::program::{config, set, summary};
use crate::{in_folder, picture, run};
use image::RgbImage;
use std::path::Path;
use std::process::Command;

/// Replays three slides of two frames; odd sizes, which MP4 pads.
fn replay(folder: &Path, arguments: &[&str]) -> Command {
    let keys = set(&["time.slides=3", "time.frames_per_slide=2", "time.tau=5"]);
    let gyre = config("double_gyre.toml");
    let size = picture([161, 81, 2]);
    let size: Vec<&str> = size.iter().map(String::as_str).collect();
    in_folder(folder, &[&["replay", gyre.as_str()][..], &keys, &size, arguments].concat())
}

fn pictures(run: &Path) -> Vec<RgbImage> {
    (0..6).map(|n| image::open(run.join(format!("frames/frame_{n:06}.png"))).unwrap().to_rgb8()).collect()
}

fn films(path: &Path) -> (Vec<RgbImage>, Vec<u16>) {
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(std::fs::File::open(path).unwrap()).unwrap();
    let (width, height) = (u32::from(decoder.width()), u32::from(decoder.height()));
    let (mut frames, mut delays) = (Vec::new(), Vec::new());
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        let rgb = frame.buffer.chunks(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        frames.push(RgbImage::from_raw(width, height, rgb).unwrap());
        delays.push(frame.delay);
    }
    (frames, delays)
}

/// Mean of the differences of the channels, in levels of 255.
fn difference(a: &RgbImage, b: &RgbImage) -> f64 {
    let sum: u64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.as_raw().len() as f64
}

/// The picture in 8 levels of red and green and 4 of blue, a palette of 256 colours that suits no picture in particular.
fn fixed_palette(picture: &RgbImage) -> RgbImage {
    let nearest = |value: u8, steps: f64| ((f64::from(value) / 255.0 * steps).round() / steps * 255.0) as u8;
    let mut coarse = picture.clone();
    coarse.pixels_mut().for_each(|p| p.0 = [nearest(p.0[0], 7.0), nearest(p.0[1], 7.0), nearest(p.0[2], 3.0)]);
    coarse
}

#[test]
fn a_gif_holds_the_pictures_of_the_run() {
    let folder = tempfile::tempdir().unwrap();
    run(&mut replay(folder.path(), &["--out", "run", "--movie", "film.gif", "--movie-fps", "8"])).success();
    let (frames, delays) = films(&folder.path().join("film.gif"));
    assert_eq!(delays, [13, 12, 13, 12, 13, 12], "8 frames a second in hundredths");
    let pictures = pictures(&folder.path().join("run"));
    assert_eq!(frames.len(), 6);
    for (frame, picture) in frames.iter().zip(&pictures) {
        assert_eq!(frame.dimensions(), picture.dimensions());
        let off = difference(frame, picture);
        let fixed = difference(&fixed_palette(picture), picture);
        assert!(off < fixed / 2.0, "256 colours that are chosen for the picture: {off} {fixed}");
    }
    assert!(difference(&frames[0], &pictures[5]) > difference(&frames[0], &pictures[0]));
    let movie = &summary(&folder.path().join("run"))["movie"];
    assert_eq!((movie["frames_written"].as_u64(), movie["frames_lost"].as_u64(), movie["failed"].is_null()), (Some(6), Some(0), true));

    // An earlier film is kept, unless --overwrite is given; the earlier run as well.
    let again = ["--out", "second", "--movie", "film.gif"];
    run(&mut replay(folder.path(), &again)).refused(1, &["film.gif", "--overwrite"]);
    assert!(!folder.path().join("second/frames").exists());
    run(&mut replay(folder.path(), &[&again[..], &["--overwrite", "--annotate"]].concat())).success();
    let (annotated, delays) = films(&folder.path().join("film.gif"));
    assert_eq!(delays, [10; 6]);
    let part = |image: &RgbImage, top: bool| {
        image::imageops::crop_imm(image, 0, if top { 0 } else { 61 }, 161, if top { 50 } else { 20 }).to_image()
    };
    assert!(difference(&part(&annotated[0], false), &part(&pictures[0], false)) > 5.0, "text below");
    assert!(difference(&part(&annotated[0], true), &part(&pictures[0], true)) < 4.0, "the picture above");
    run(&mut replay(folder.path(), &["--out", "third", "--movie", "film.avi"])).refused(2, &["film.avi", ".gif or .mp4"]);
}

#[test]
fn a_film_of_maps_holds_the_map_of_each_slide() {
    let folder = tempfile::tempdir().unwrap();
    let film = ["--out", "run", "--movie", "maps.gif", "--movie-of", "maps", "--movie-fps", "2"];
    run(&mut replay(folder.path(), &[&film[..], &set(&["maps.ridges=true"])].concat())).success();
    let (frames, delays) = films(&folder.path().join("maps.gif"));
    assert_eq!(delays, [50; 3], "one a slide");
    for (number, frame) in frames.iter().enumerate() {
        let map = image::open(folder.path().join(format!("run/maps/slide_{number:06}.png"))).unwrap().to_rgb8();
        assert_eq!(frame.dimensions(), map.dimensions());
        // Most of the page is white; its colours are those of the map.
        let spread = |pixel: &[u8; 3]| pixel.iter().max().unwrap() - pixel.iter().min().unwrap();
        let coloured: Vec<_> = map.pixels().zip(frame.pixels()).filter(|(pixel, _)| spread(&pixel.0) > 60).collect();
        let off = coloured.iter().flat_map(|(a, b)| (0..3).map(|k| f64::from(a.0[k].abs_diff(b.0[k])))).sum::<f64>();
        let mean = off / (3 * coloured.len()) as f64;
        assert!(coloured.len() > 5000 && mean < 16.0, "slide {number}: {mean} over {} pixels", coloured.len());
    }
    assert!(frames[0] != frames[1] && frames[1] != frames[2]);
    let movie = &summary(&folder.path().join("run"))["movie"];
    assert_eq!((movie["frames_written"].as_u64(), movie["frames_lost"].as_u64(), movie["failed"].is_null()), (Some(3), Some(0), true));

    let film = ["--out", "second", "--movie", "second.gif", "--movie-of", "maps"];
    run(&mut replay(folder.path(), &[&film[..], &set(&["publish.maps=false"])].concat())).refused(2, &["--movie-of maps", "publish.maps"]);
    run(&mut in_folder(folder.path(), &[&["replay", &config("abc.toml")][..], &film].concat())).refused(2, &["three dimensions"]);
    run(&mut replay(folder.path(), &["--out", "second", "--movie-of", "maps"])).refused(2, &["--movie"]);
    assert!(!folder.path().join("second").exists() && !folder.path().join("second.gif").exists());
}

#[test]
fn an_mp4_without_ffmpeg_says_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = replay(folder.path(), &["--out", "run", "--movie", "film.mp4"]);
    run(command.env("PATH", folder.path())).refused(1, &["film.mp4", "ffmpeg cannot be started", "apt install ffmpeg", ".gif"]);
    assert!(!folder.path().join("run").exists() && !folder.path().join("film.mp4").exists());
}

/// Types and contents of the boxes in a box (ISO/IEC 14496-12, 4.2).
fn boxes(mut bytes: &[u8]) -> Vec<(String, &[u8])> {
    let mut found = Vec::new();
    while !bytes.is_empty() {
        let size = u32::from_be_bytes(bytes[..4].try_into().unwrap()) as usize;
        assert!(size >= 8 && size <= bytes.len(), "a box of {size} bytes in {}", bytes.len());
        found.push((String::from_utf8(bytes[4..8].to_vec()).unwrap(), &bytes[8..size]));
        bytes = &bytes[size..];
    }
    found
}

fn inside<'a>(bytes: &'a [u8], path: &[&str]) -> Vec<&'a [u8]> {
    let Some((first, rest)) = path.split_first() else { return vec![bytes] };
    boxes(bytes).into_iter().filter(|(name, _)| name == first).flat_map(|(_, content)| inside(content, rest)).collect()
}

#[test]
#[ignore = "needs ffmpeg: make test-movies"]
fn an_mp4_holds_the_frames_of_the_run() {
    let folder = tempfile::tempdir().unwrap();
    run(&mut replay(folder.path(), &["--out", "run", "--movie", "film.mp4", "--movie-fps", "2"])).success();
    let bytes = std::fs::read(folder.path().join("film.mp4")).unwrap();
    // Fragments with four frames at most: an interruption costs the last.
    let samples: Vec<u32> =
        inside(&bytes, &["moof", "traf", "trun"]).iter().map(|trun| u32::from_be_bytes(trun[4..8].try_into().unwrap())).collect();
    assert_eq!((samples.iter().sum::<u32>(), samples.len()), (6, 2), "{samples:?}");
    // Width and height in 16.16 at the end of the track's header, to even numbers.
    let header = inside(&bytes, &["moov", "trak", "tkhd"])[0];
    let edge = |from: usize| u32::from_be_bytes(header[from..from + 4].try_into().unwrap()) >> 16;
    assert_eq!((edge(header.len() - 8), edge(header.len() - 4)), (162, 82));
    // Up to the second fragment, the film is whole.
    let second = bytes.windows(4).enumerate().filter(|(_, w)| *w == b"moof").map(|(at, _)| at - 4).nth(1).unwrap();
    std::fs::write(folder.path().join("cut.mp4"), &bytes[..second]).unwrap();
    let probe = |name: &str| {
        let entries =
            ["-count_frames", "-select_streams", "v", "-show_entries", "stream=codec_name,nb_read_frames,r_frame_rate", "-of", "csv=p=0"];
        let said = Command::new("ffprobe").args(["-v", "error"]).args(entries).arg(folder.path().join(name)).output().unwrap();
        String::from_utf8(said.stdout).unwrap().trim().to_owned()
    };
    assert_eq!((probe("film.mp4").as_str(), probe("cut.mp4").as_str()), ("h264,2/1,6", "h264,2/1,4"));
    // The colours are those of the pictures.
    let decode = ["-v", "error", "-i", "film.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"];
    let raw = Command::new("ffmpeg").args(decode).current_dir(folder.path()).output().unwrap().stdout;
    assert_eq!(raw.len(), 6 * 162 * 82 * 3);
    for (frame, picture) in raw.chunks(162 * 82 * 3).zip(pictures(&folder.path().join("run"))) {
        let frame = RgbImage::from_raw(162, 82, frame.to_vec()).unwrap();
        let off = difference(&image::imageops::crop_imm(&frame, 0, 0, 161, 81).to_image(), &picture);
        // Colours have half the pixels along each edge, and the picture is noise of two samples.
        assert!(off < 4.0, "{off}");
    }
}
