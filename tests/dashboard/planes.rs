//! Layers of the newest frame as f16: those of its film, whole, bounded and for those who know a token.

use crate::kit::program::{ridgewatch, set, start, text};
use crate::kit::scene::{self, double_gyre};
use crate::values::{body, bytes, film, frame, stage, url};
use crate::visitor::{Received, Visitor, get};
use crate::{LIMIT, Stage};
use exr::prelude::f16;
use ridgewatch::publish::read_exr;
use ridgewatch::render::Film;
use serde_json::json;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

/// Head and values of a plane.
fn plane(address: SocketAddr, token: &str, query: &str) -> (serde_json::Value, Vec<f64>) {
    let (head, body) = bytes(address, &format!("/plane?{query}&token={token}"));
    assert!(head.starts_with("HTTP/1.1 200") && head.contains("application/octet-stream"), "{head}");
    let Received { json, payload } = Received::of(&body);
    let scale = json["scale"].as_f64().unwrap();
    let values = payload.chunks_exact(2).map(|pair| f16::from_le_bytes([pair[0], pair[1]]).to_f64() * scale).collect();
    (json, values)
}

/// Equal to half of the last of the 11 bits of f16, or both without a value.
fn agrees(found: &[f64], wanted: &[f32]) {
    assert_eq!(found.len(), wanted.len());
    let largest = wanted.iter().filter(|value| value.is_finite()).fold(0.0_f32, |a, b| a.max(b.abs()));
    for (found, wanted) in found.iter().zip(wanted) {
        let wanted = f64::from(*wanted);
        // Below 2^-14 of the scale, of which the largest value is at least half, bits are lost.
        let bound = wanted.abs() * 2_f64.powi(-11) + f64::from(largest) * 2_f64.powi(-24);
        assert!((found - wanted).abs() <= bound || (found.is_nan() && !wanted.is_finite()), "{found} {wanted}");
    }
}

#[test]
fn a_plane_has_the_layer_of_the_film() {
    let mut film = film([9, 4], true);
    film.queries = (0..36).map(|pixel| (pixel % 3) as f32).collect();
    film.missing[7] = 0.5;
    let (stage, newest) = stage(Some(frame(12, film.clone())));
    let (address, token) = (stage.address(), &stage.token);
    let traced: Vec<f32> = film.traced.iter().zip(&film.queries).map(|(t, q)| if *q > 0.0 { *t } else { f32::NAN }).collect();
    for (of, layer, unit) in
        [("ftle", &film.ftle_mean, "1/day"), ("error", &film.error, ""), ("traced", &traced, ""), ("missing", &film.missing, "")]
    {
        let (head, values) = plane(address, token, &format!("of={of}&frame=12"));
        let told = |key: &str| &head[key];
        assert_eq!((told("plane"), told("frame"), told("slide"), told("unit")), (&json!(of), &json!(12), &json!(2), &json!(unit)));
        assert_eq!((told("size"), told("step"), told("columns"), told("rows")), (&json!([9, 4]), &json!(1), &json!(9), &json!(4)));
        agrees(&values, layer);
    }
    newest.put(frame(13, Film { error: Vec::new(), ..film }));
    let (head, values) = plane(address, token, "of=error");
    assert_eq!(head["none"], "gated states no error of a pixel; map, marched and two_level do");
    assert!(values.is_empty() && head["columns"] == 0 && head["frame"] == 13);
    for (query, status, words) in [
        ("of=error&frame=12&", 410, "frame 12 is no longer kept"),
        ("of=light&", 400, "`of` is \"light\"; accepted: ftle, error, traced, missing, trusted"),
        ("", 400, "`of` is \"\""),
        ("of=ftle&frame=-1&", 400, "`frame` is \"-1\""),
        (&format!("of={}&", "x".repeat(8000)), 400, "`of` is \"xxx"),
    ] {
        let (found, answer) = get(address, &format!("/node/a/plane?{query}token={token}"), &[]);
        assert!(found == status && body(&answer).contains(words) && answer.len() < 1000, "{query}: {answer}");
    }
    let alone = Stage::new();
    let (status, answer) = get(alone.address(), &format!("/plane?of=ftle&token={}", alone.token), &[]);
    assert!(status == 404 && answer.contains("the run is not reached"), "{answer}");
}

#[test]
fn the_histogram_counts_the_pixels_of_the_frame() {
    let film = film([9, 4], true);
    let (stage, newest) = stage(Some(frame(12, film.clone())));
    let target = format!("/histogram?token={}", stage.token);
    let (status, answer) = get(stage.address(), &target, &[]);
    let found: serde_json::Value = serde_json::from_str(body(&answer)).unwrap();
    // One of the pixels has no value.
    let known: Vec<f64> = film.ftle_mean.iter().copied().map(f64::from).filter(|value| value.is_finite()).collect();
    let (low, high) = known.iter().fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(*value), high.max(*value)));
    assert_eq!((status, &found["frame"], &found["pixels"], &found["unit"]), (200, &json!(12), &json!(36), &json!("1/day")));
    assert_eq!(found["range"], json!([low, high]));
    let mut counts = vec![0; 64];
    known.iter().for_each(|value| counts[(((value - low) / (high - low) * 64.0) as usize).min(63)] += 1);
    assert_eq!(found["counts"], json!(counts));
    newest.put(frame(13, Film::new(9, 4)));
    let (_, answer) = get(stage.address(), &target, &[]);
    let found: serde_json::Value = serde_json::from_str(body(&answer)).unwrap();
    assert!(found["range"].is_null() && found["frame"] == 13);
    assert_eq!(get(stage.address(), &format!("{target}&frame=12"), &[]).0, 410);
    let alone = Stage::new();
    assert_eq!(get(alone.address(), &format!("/histogram?token={}", alone.token), &[]).0, 404);
}

/// Those who take their planes slowly keep others from planes, and from nothing else.
#[test]
fn large_planes_are_thinned_and_few_are_on_their_way() {
    let large = Film { width: 4096, height: 2048, ftle_mean: vec![0.5; 4096 * 2048], ..Film::default() };
    let (stage, newest) = stage(Some(frame(1, large)));
    let (address, token) = (stage.address(), &stage.token);
    let (head, body) = bytes(address, &format!("/plane?of=ftle&token={token}"));
    let Received { json, payload } = Received::of(&body);
    assert!(head.starts_with("HTTP/1.1 200") && body.len() < 10_000_000, "{head}");
    assert_eq!((&json["step"], &json["columns"], &json["rows"], payload.len()), (&json!(2), &json!(2048), &json!(1024), 4 << 20));
    // As large as a plane may be: no buffers of sockets take all of it.
    newest.put(frame(2, Film { width: 2048, height: 2048, ftle_mean: vec![0.5; 2048 * 2048], ..Film::default() }));
    let slow: Vec<TcpStream> = (0..4)
        .map(|_| {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.set_read_timeout(Some(LIMIT)).unwrap();
            write!(stream, "GET /plane?of=ftle&token={token} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
            stream.read_exact(&mut [0; 64]).unwrap();
            stream
        })
        .collect();
    let (status, answer) = get(address, &format!("/plane?of=ftle&token={token}"), &[]);
    assert!(status == 503 && answer.contains("other planes are on their way"), "{}", &answer[..answer.len().min(300)]);
    // The pixel has no colours.
    assert_eq!(get(address, &format!("/values?x=0&y=0&token={token}"), &[]).0, 200);
    drop(slow);
    // It waits for a place.
    assert_eq!(bytes(address, &format!("/plane?of=ftle&token={token}")).0.split(' ').nth(1), Some("200"));
}

#[test]
fn a_run_sends_the_layers_of_the_exr_that_it_writes() {
    let folder = tempfile::tempdir().unwrap();
    let lines = "time.tau = 10\ntime.slides = 10000\nrender.method = \"two_level\"\nsurrogate.kind = \"table\"\n";
    let scene = scene::write(folder.path(), &double_gyre([32, 16, 1], lines));
    let run = folder.path().join("gyre");
    let mut replay = ridgewatch(["replay", &scene, "--json", "--out", text(&run), "--dashboard=0"]);
    let endpoint = format!("ipc://{}", folder.path().join("frames").display());
    replay.args(["--publish", &endpoint]).args(set(&["flow.steps=20", "publish.preview=false", "publish.exr=\"every\""]));
    let running = start(&mut replay);
    let (address, token) = url(&running);
    Visitor::open(address, &token).frame();
    let planes = ["ftle", "error", "traced"].map(|of| plane(address, &token, &format!("of={of}")));
    running.signal(libc::SIGTERM);
    running.wait();
    for (head, values) in planes {
        let film = read_exr(&run.join(format!("frames/frame_{:06}.exr", head["frame"].as_u64().unwrap()))).unwrap();
        match head["plane"].as_str().unwrap() {
            "ftle" => agrees(&values, &film.ftle_mean),
            "error" => agrees(&values, &film.error),
            _ => agrees(
                &values,
                &film.traced.iter().zip(&film.queries).map(|(t, q)| if *q > 0.0 { *t } else { f32::NAN }).collect::<Vec<_>>(),
            ),
        }
        assert!(values.iter().any(|value| *value > 0.0), "{head}");
    }
}
