//! Values of pixels and downloads: those of the frame's EXR, and why there are none.

use crate::kit::program::{Running, ridgewatch, run, set, start, text, until};
use crate::kit::publishing;
use crate::kit::scene::{self, double_gyre};
use crate::visitor::{Visitor, ask, get};
use crate::{LIMIT, Stage, raw_publisher};
use ridgewatch::field::{Domain, EARTH_RADIUS};
use ridgewatch::publish::{
    FrameHeader, MapAbout, NewestFrame, NewestSlide, NoField, Payload, channels_at, decode_exr, encode_exr, jpeg, png, read_exr,
};
use ridgewatch::render::{CameraSettings, Film, MapPlane, Method, ProjectionChoice, RenderSettings, Scene};
use ridgewatch::run::{ColorBar, DomainRecord, Frame, FrameRecord, ShownSlide};
use ridgewatch_zmtp::Keep;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// A film whose pixels all differ, with an error a pixel or without.
pub fn film([width, height]: [usize; 2], has_error: bool) -> Film {
    let pixels = width * height;
    let layer = |from: f32| (0..pixels).map(|i| from + (i as f32).sqrt()).collect::<Vec<_>>();
    let mut film = Film {
        ftle_mean: layer(0.1),
        traced: layer(1.0),
        samples: vec![4.0; pixels],
        queries: vec![4.0; pixels],
        ..Film::new(width, height)
    };
    film.rgba = (0..pixels).map(|i| [i as f32 / 7.0, 1.0 / (i as f32 + 3.0), -0.25, 1.0]).collect();
    film.ftle_mean[1] = f32::NAN;
    film.error = if has_error { layer(1e-3) } else { Vec::new() };
    film
}

pub fn frame(number: u64, film: Film) -> Frame {
    let record = FrameRecord { frame: number, slide: 2, size: [film.width, film.height], method: "gated".into(), ..Default::default() };
    let bar = ColorBar { colors: vec![[1, 2, 3]; 32], low: 0.5, high: 2.0, unit: "1/day".into() };
    Frame { color_bar: Some(Arc::new(bar)), ..publishing::frame(record, film) }
}

pub fn stage(frame: Option<Frame>) -> (Stage, Arc<NewestFrame>) {
    let newest = Arc::new(NewestFrame::new(Path::new("out/gulf"), MapAbout::default()));
    frame.into_iter().for_each(|frame| newest.put(frame));
    (stage_of(Arc::clone(&newest)), newest)
}

pub fn stage_of(newest: Arc<NewestFrame>) -> Stage {
    Stage::with(tempfile::tempdir().unwrap(), None, Some(newest))
}

pub fn body(answer: &str) -> &str {
    answer.split_once("\r\n\r\n").unwrap().1
}

/// Head and bytes of an answer.
pub fn bytes(address: SocketAddr, target: &str) -> (String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    write!(stream, "GET {target} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|part| part == b"\r\n\r\n").unwrap();
    (String::from_utf8_lossy(&answer[..end]).into_owned(), answer[end + 4..].to_vec())
}

/// The channels of a JSON answer are those of the film at that pixel, to the last bit.
pub fn agrees(values: &Value, film: &Film) {
    let pixel = [values["x"].as_u64().unwrap() as usize, values["y"].as_u64().unwrap() as usize];
    let expected = channels_at(film, pixel);
    assert_eq!(values["channels"].as_object().unwrap().len(), expected.len(), "{values}");
    for (name, value) in expected {
        let told = &values["channels"][name];
        match told.as_f64() {
            Some(told) => assert_eq!((told as f32).to_bits(), value.to_bits(), "{name} {values}"),
            None => assert!(told.is_null() && !value.is_finite(), "{name} {values}"),
        }
    }
}

#[test]
fn a_pixel_has_the_values_of_the_exr_that_is_downloaded() {
    let (stage, _newest) = stage(Some(frame(12, film([9, 4], true))));
    let (address, token) = (stage.address(), &stage.token);
    let (head, exr) = bytes(address, &format!("/node/a/frame.exr?token={token}&frame=12"));
    assert!(head.starts_with("HTTP/1.1 200") && head.contains("filename=\"gulf-frame-000012-slide-0002.exr\""), "{head}");
    let film = decode_exr(&exr).unwrap();
    assert_eq!((film.width, film.height, film.error.len()), (9, 4, 36));
    for (x, y) in (0..36).map(|pixel| (pixel % 9, pixel / 9)) {
        let (status, answer) = get(address, &format!("/values?token={token}&x={x}&y={y}"), &[]);
        assert_eq!(status, 200, "{answer}");
        let values: Value = serde_json::from_str(body(&answer)).unwrap();
        assert_eq!((&values["x"], &values["y"], &values["frame"], &values["unit"]), (&json!(x), &json!(y), &json!(12), &json!("1/day")));
        assert!(values.get("no_error").is_none());
        agrees(&values, &film);
    }
    let (head, picture) = bytes(address, &format!("/frame.png?token={token}"));
    assert!(head.contains("content-type: image/png") && head.contains("gulf-frame-000012-slide-0002.png"), "{head}");
    assert_eq!(picture, png(&film, [1.0, 0.5, 1.0]).unwrap());
    let (head, record) = bytes(address, &format!("/frame.json?token={token}"));
    assert!(head.contains("gulf-frame-000012-slide-0002.json"), "{head}");
    assert_eq!(serde_json::from_slice::<FrameRecord>(&record).unwrap().frame, 12);
}

#[test]
fn what_cannot_be_told_is_said_in_words() {
    let (stage, newest) = stage(None);
    let (address, token) = (stage.address(), stage.token.clone());
    let said = |target: &str| get(address, &format!("{target}token={token}"), &[]);
    let refused = |target: &str, status: u16, words: &str| {
        let (found, answer) = said(target);
        assert!(found == status && body(&answer).contains(words), "{target}: {answer}");
    };
    refused("/values?x=0&y=0&", 404, "no frame is complete yet");
    refused("/frame.exr?", 404, "no frame is complete yet");
    newest.put(frame(7, film([9, 4], false)));
    newest.put(frame(8, film([9, 4], false)));
    refused("/values?x=0&y=0&frame=7&", 410, "frame 7 is no longer kept: the run keeps its newest one, 8 by now");
    refused("/frame.exr?frame=7&", 410, "frame 7 is no longer kept");
    assert_eq!(said("/frame.png?frame=7&if=newest&").0, 204);
    assert_eq!(said("/frame.png?frame=8&if=newest&").0, 200);
    for (query, words) in [
        ("x=9&y=0&", "`x` is \"9\"; accepted: a pixel of the picture, 0 to 8"),
        ("x=0&y=4&", "`y` is \"4\"; accepted: a pixel of the picture, 0 to 3"),
        ("x=-1&y=0&", "`x` is \"-1\""),
        ("x=18446744073709551616&y=0&", "`x` is \"18446744073709551616\""),
        ("y=0&", "`x` is \"\""),
        ("x=0&y=0&frame=new&", "`frame` is \"new\"; accepted: the number of a frame"),
    ] {
        refused(&format!("/values?{query}"), 400, words);
    }
    let (status, answer) = said("/values?x=0&y=0&frame=8&");
    let values: Value = serde_json::from_str(body(&answer)).unwrap();
    assert!(status == 200 && values["channels"].get("error").is_none());
    assert_eq!(values["no_error"], "gated states no error of a pixel; map, marched and two_level do");
    // A process of its own has no frames, and does not wait for those of a run that is not there.
    let (alone, begin) = (Stage::new(), Instant::now());
    let (status, answer) = get(alone.address(), &format!("/values?x=0&y=0&token={}", alone.token), &[]);
    assert!(status == 404 && answer.contains("the run is not reached") && begin.elapsed() < Duration::from_secs(3), "{answer}");
    assert_eq!(stage.visit().until_state(|_| true)["values"], json!({"ready": "gulf"}));
}

/// A camera straight above a point, which shows this half-width.
fn above(x: f64, y: f64, half_width: f64) -> CameraSettings {
    let (eye, look_at) = ([x, y, 0.2 + half_width], [x, y, 0.2]);
    CameraSettings { eye, look_at, up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true }
}

/// A map of [0, 2] x [0, 1], seen from straight above.
pub fn map_frame_above(number: u64, size: [usize; 2]) -> Frame {
    map_frame(number, size, above(1.0, 0.5, 1.0))
}

/// A map of [0, 2] x [0, 1].
fn map_frame(number: u64, size: [usize; 2], camera: CameraSettings) -> Frame {
    let axes = [["x", ""], ["y", ""]].map(|axis| axis.map(str::to_owned)).to_vec();
    let domain = DomainRecord { min: [0.0; 3], max: [2.0, 1.0, 0.2], axes };
    let record = FrameRecord {
        method: "map".into(),
        camera: Some(camera),
        scale: [1.0; 3],
        domain: Some(domain),
        direction: "backward".into(),
        time: 5.0,
        tau: 2.0,
        ..(*frame(number, film(size, true)).record).clone()
    };
    Frame { record: Arc::new(record), ..frame(number, film(size, true)) }
}

#[test]
fn a_map_is_a_field_on_axes() {
    let (stage, newest) = stage(Some(map_frame(3, [8, 4], above(1.0, 0.5, 1.0))));
    let (address, token) = (stage.address(), stage.token.clone());
    let read = || {
        let (head, found) = bytes(address, &format!("/frame.nc?token={token}"));
        assert!(head.starts_with("HTTP/1.1 200") && head.contains("slide-0002.nc\""), "{head}: {}", String::from_utf8_lossy(&found));
        let file = tempfile::Builder::new().suffix(".nc").tempfile().unwrap();
        std::fs::write(file.path(), found).unwrap();
        let opened = netcdf::open(file.path()).unwrap();
        let values = |name: &str| opened.variable(name).unwrap().get_values::<f64, _>(..).unwrap();
        (["x", "y", "time", "ftle", "ftle_error", "missing_share"].map(values), values("time_bounds"), values("y_bounds"))
    };
    let film = film([8, 4], true);
    let ([x, y, time, ftle, error, missing], bounds, of_y) = read();
    assert_eq!((of_y.len(), (of_y[1] - of_y[0] - 0.25).abs() < 1e-12, (of_y[1] - of_y[2]).abs() < 1e-12), (8, true, true), "{of_y:?}");
    // Centres of pixels, upwards; the film is from the top.
    // Up to the rounding of the camera.
    let lie_at =
        |found: &[f64], wanted: &[f64]| found.len() == wanted.len() && found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(
        lie_at(&x, &[0.125, 0.375, 0.625, 0.875, 1.125, 1.375, 1.625, 1.875]) && lie_at(&y, &[0.125, 0.375, 0.625, 0.875]),
        "{x:?} {y:?}"
    );
    assert_eq!((time, bounds, missing), (vec![5.0], vec![3.0, 5.0], vec![0.0; 32]));
    for (i, (ftle, error)) in ftle.iter().zip(&error).enumerate() {
        let pixel = (3 - i / 8) * 8 + i % 8;
        assert_eq!(*error, f64::from(film.error[pixel]));
        // Pixel 1 has no value, and the fill value of NetCDF.
        assert_eq!(*ftle, if pixel == 1 { 9.969_209_968_386_869e36 } else { f64::from(film.ftle_mean[pixel]) });
    }
    // Twice as far away the domain is the middle quarter, and pixels of other places are left out.
    newest.put(map_frame(4, [8, 4], above(1.0, 0.5, 2.0)));
    let ([x, y, _, ftle, ..], ..) = read();
    assert!(lie_at(&x, &[0.25, 0.75, 1.25, 1.75]) && lie_at(&y, &[0.25, 0.75]), "{x:?} {y:?}");
    assert_eq!(ftle[0], f64::from(film.ftle_mean[2 * 8 + 2]));
    for (camera, words) in [
        (CameraSettings { up: [1.0, 1.0, 0.0], ..above(1.0, 0.5, 1.0) }, "turned or tilted"),
        (CameraSettings { eye: [1.0, 0.0, 2.0], orthographic: false, ..above(1.0, 0.5, 1.0) }, "turned or tilted"),
        (above(9.0, 0.5, 1.0), "no pixel lies in the domain"),
    ] {
        newest.put(map_frame(5, [8, 4], camera));
        let (status, answer) = get(address, &format!("/frame.nc?token={token}"), &[]);
        assert!(status == 404 && answer.contains(words), "{answer}");
    }
    newest.put(frame(6, film));
    let (status, answer) = get(address, &format!("/frame.nc?token={token}"), &[]);
    assert!(status == 404 && answer.contains("a picture of a volume"), "{answer}");
}

/// A map of longitudes and latitudes in the projection of a name, which fills its picture.
fn projected_frame(projection: ProjectionChoice, [west, south, east, north]: [f64; 4], size: [usize; 2]) -> (Frame, MapPlane) {
    let domain = Domain { is_geographic: true, ..Domain::slab([west, south], [east, north], (0.0, 1.0)) };
    let [width, height] = size;
    let settings = RenderSettings { method: Method::Map, width, height, projection, ..RenderSettings::default() };
    let scene = Scene::assemble(&domain, None, None, None, settings, 0);
    let axes = [["lon", "degrees_east"], ["lat", "degrees_north"]].map(|axis| axis.map(str::to_owned)).to_vec();
    let found = map_frame(3, size, scene.camera);
    let record = FrameRecord {
        scale: scene.scale,
        projection: scene.plane,
        domain: Some(DomainRecord { min: domain.min, max: domain.max, axes }),
        ..(*found.record).clone()
    };
    (Frame { record: Arc::new(record), ..found }, scene.plane.unwrap())
}

#[test]
fn a_map_in_a_projection_is_a_field_in_its_plane() {
    let cap = [0.0, 60.0, 360.0, 90.0];
    let (frame, plane) = projected_frame(ProjectionChoice::Polar, cap, [8, 8]);
    let (stage, newest) = stage(Some(frame));
    let (address, token) = (stage.address(), stage.token.clone());
    let read = || {
        let (head, found) = bytes(address, &format!("/frame.nc?token={token}"));
        assert!(head.starts_with("HTTP/1.1 200"), "{head}: {}", String::from_utf8_lossy(&found));
        let file = tempfile::Builder::new().suffix(".nc").tempfile().unwrap();
        std::fs::write(file.path(), found).unwrap();
        netcdf::open(file.path()).unwrap()
    };
    let values = |file: &netcdf::File, name: &str| file.variable(name).unwrap().get_values::<f64, _>(..).unwrap();
    let words = |file: &netcdf::File, name: &str, attribute: &str| {
        file.variable(name).unwrap().attribute_value(attribute).unwrap().unwrap().try_into().unwrap_or_else(|_| String::new())
    };
    let file = read();
    let [x, y, lon, lat, ftle] = ["x", "y", "lon", "lat", "ftle"].map(|name| values(&file, name));
    // The parallel of 60 degrees is the rim of the picture: 2 R tan 15 degrees from the pole.
    let rim = 2.0 * 15_f64.to_radians().tan() * EARTH_RADIUS;
    for (k, found) in x.iter().enumerate() {
        let wanted = rim * ((k as f64 + 0.5) / 4.0 - 1.0);
        assert!((found - wanted).abs() < 1e-3 * rim && (y[k] - wanted).abs() < 1e-3 * rim, "{x:?} {y:?}");
    }
    assert_eq!((lon.len(), lat.len(), ftle.len()), (64, 64, 64));
    for (i, (lon, lat)) in lon.iter().zip(&lat).enumerate() {
        let [u, v] = plane.projection.inverse([x[i % 8] / EARTH_RADIUS, y[i / 8] / EARTH_RADIUS]);
        assert!((lon - u).abs() < 1e-6 && (lat - v).abs() < 1e-6, "pixel {i}: {lon} {lat}, not {u} {v}");
    }
    assert_eq!((words(&file, "ftle", "coordinates"), words(&file, "ftle", "grid_mapping")), ("lon lat".to_owned(), "crs".to_owned()));
    assert_eq!(words(&file, "crs", "grid_mapping_name"), "polar_stereographic");
    assert_eq!(words(&file, "x", "standard_name"), "projection_x_coordinate");
    // Upwards, as the axis; the film is from the top.
    let film = film([8, 8], true);
    assert_eq!(ftle[0], f64::from(film.ftle_mean[7 * 8]));
    // A pixel without a seed in the domain.
    let mut unseen = projected_frame(ProjectionChoice::Polar, cap, [8, 8]).0;
    let film = Arc::make_mut(&mut unseen.film);
    (film.ftle_mean[0], film.queries[0]) = (f32::NAN, 0.0);
    newest.put(unseen);
    let share = values(&read(), "missing_share");
    assert!(!(0.0..=1.0).contains(&share[7 * 8]) && share[7 * 8 + 1] >= 0.0, "{share:?}");
    // Beside the cone of a region there is no place.
    newest.put(projected_frame(ProjectionChoice::Lambert, [-20.0, 30.0, 50.0, 72.0], [8, 8]).0);
    let file = read();
    assert_eq!(words(&file, "crs", "grid_mapping_name"), "lambert_conformal_conic");
    // In plate carree, longitudes and latitudes are axes.
    newest.put(projected_frame(ProjectionChoice::PlateCarree, [-170.0, -80.0, 170.0, 80.0], [17, 8]).0);
    let file = read();
    let (x, y) = (values(&file, "x"), values(&file, "y"));
    assert!(file.variable("lon").is_none() && (x.len(), y.len()) == (17, 8));
    assert!((x[0] + 160.0).abs() < 1e-9 && (y[0] + 70.0).abs() < 1e-9, "{x:?} {y:?}");
}

/// A dashboard that is a process of its own has what the run publishes.
#[test]
fn frames_that_are_published_with_all_layers_are_served() {
    let stage = Stage::new();
    let (address, token) = (stage.address(), &stage.token);
    let mut visitor = stage.visit();
    let publisher = raw_publisher(&stage, &mut visitor);
    let (status, answer) = get(address, &format!("/values?x=0&y=0&token={token}"), &[]);
    assert!(status == 404 && answer.contains("the layers of its newest frame have not come"), "{answer}");
    let sent = frame(12, film([9, 4], true));
    let sent = Frame { record: Arc::new(FrameRecord { surrogate: Some("table".into()), ..(*sent.record).clone() }), ..sent };
    let exr = encode_exr(&sent.film, Some(&sent.record)).unwrap();
    let header = FrameHeader {
        protocol: 3,
        frame: 12,
        encoding: Payload::Exr,
        shape: [4, 9, 4],
        dtype: "float32".into(),
        payload_bytes: exr.len(),
        tone_map: sent.tone_map,
        color_bar: sent.color_bar.as_deref().cloned(),
        record: (*sent.record).clone(),
        trusted: None,
        about: None,
    };
    let publish = |header: &FrameHeader, picture: &[u8]| {
        let json = serde_json::to_vec(header).unwrap();
        publisher.send(&[b"frame", &json], picture.to_vec(), Keep::All);
    };
    publish(&header, &exr);
    let shown = visitor.frame();
    assert_eq!(shown.payload, jpeg(&sent.film, sent.tone_map).unwrap(), "a browser gets what it can draw");
    let told: FrameHeader = serde_json::from_value(shown.json["header"].clone()).unwrap();
    assert_eq!((told.encoding, told.shape, told.payload_bytes), (Payload::Jpeg, [4, 9, 3], shown.payload.len()));
    assert_eq!((&told.record, &told.color_bar), (&header.record, &header.color_bar));
    visitor.until_state(|state| state["values"]["ready"] == "run");
    for (x, y) in (0..36).map(|pixel| (pixel % 9, pixel / 9)) {
        let (status, answer) = get(address, &format!("/values?token={token}&x={x}&y={y}"), &[]);
        assert_eq!(status, 200, "{answer}");
        agrees(&serde_json::from_str(body(&answer)).unwrap(), &sent.film);
    }
    let (head, file) = bytes(address, &format!("/frame.exr?token={token}"));
    assert!(head.contains("run-frame-000012-slide-0002.exr"), "{head}");
    let saved = decode_exr(&file).unwrap();
    for pixel in (0..36).map(|pixel| [pixel % 9, pixel / 9]) {
        let bits = |film: &Film| channels_at(film, pixel).into_iter().map(|(name, value)| (name, value.to_bits())).collect::<Vec<_>>();
        assert_eq!(bits(&saved), bits(&sent.film), "{pixel:?}");
    }
    // As an earlier version sends it, which told less.
    for (target, status, words) in [
        ("/plane?of=error&", 200, ""),
        ("/histogram?", 200, "counts"),
        ("/plane?of=trusted&", 404, "the run did not send its trusted cells"),
        ("/field.nc?", 404, "only a run with --dashboard has it"),
        ("/frame.nc?", 404, "the run did not tell what its coordinates mean"),
    ] {
        let (found, answer) = get(address, &format!("{target}token={token}"), &[]);
        assert!(found == status && answer.contains(words), "{target} {answer}");
    }
    // What is no picture is told, and the one before stays.
    let half = &exr[..exr.len() / 2];
    publish(&FrameHeader { payload_bytes: half.len(), ..header.clone() }, half);
    visitor.until_state(|state| state["problem"].as_str().is_some_and(|problem| problem.contains("not a readable EXR file")));
    publish(&FrameHeader { shape: [9, 4, 4], ..header.clone() }, &exr);
    visitor.until_state(|state| {
        state["problem"].as_str().is_some_and(|problem| problem.contains("of another size than its header says, 4 x 9"))
    });
    assert_eq!(get(address, &format!("/values?token={token}&x=0&y=0&frame=12"), &[]).0, 200);
    let picture = || bytes(address, &format!("/frame.png?token={token}")).1;
    assert_eq!(picture(), png(&decode_exr(&exr).unwrap(), sent.tone_map).unwrap());
    // The next run begins with the same numbers, and has another picture.
    let other = Film { rgba: vec![[0.25, 0.5, 0.75, 1.0]; 36], ..film([9, 4], true) };
    let exr = encode_exr(&other, Some(&sent.record)).unwrap();
    publish(&FrameHeader { payload_bytes: exr.len(), ..header.clone() }, &exr);
    visitor.frame();
    until("its picture", || picture() == png(&other, sent.tone_map).unwrap());
    // And one after it publishes no layers.
    let plain = FrameHeader { encoding: Payload::Jpeg, payload_bytes: 3, ..header.clone() };
    publish(&plain, b"abc");
    assert_eq!(visitor.frame().payload, b"abc");
    until("they are given up", || get(address, &format!("/frame.png?if=newest&token={token}"), &[]).0 == 204);
    // Nor would it of a picture as large as this.
    publish(&FrameHeader { shape: [2049, 2048, 3], ..plain }, b"abc");
    visitor.until_state(|state| state["values"]["none"].as_str().is_some_and(|why| why.contains("up to 4194304 pixels")));
    let (status, answer) = get(address, &format!("/frame.exr?token={token}"), &[]);
    assert!(status == 413 && answer.contains("up to 4194304 pixels"), "{answer}");
    assert_eq!(ridgewatch::publish::MAX_LAYERED_PIXELS, 4_194_304);
}

#[test]
fn frames_go_to_those_who_know_a_token() {
    let (stage, _newest) = stage(Some(map_frame(1, [8, 4], above(1.0, 0.5, 1.0))));
    let address = stage.address();
    let watching = stage.dashboard.watching_url().split("token=").nth(1).unwrap().to_owned();
    // A field takes processors from the run, and this stage has none.
    for (token, status, words) in [(&watching, 403, "only watches"), (&stage.token, 404, ""), (&String::new(), 403, "token")] {
        let (found, answer) = get(address, &format!("/field.nc?token={token}"), &[]);
        assert!(found == status && answer.contains(words), "{answer}");
    }
    for target in ["/values?x=0&y=0&", "/plane?of=ftle&", "/histogram?", "/frame.exr?", "/frame.png?", "/frame.json?", "/frame.nc?"] {
        assert_eq!(get(address, &format!("{target}token={watching}"), &[]).0, 200, "{target}");
        assert_eq!(get(address, &format!("{target}token={}", stage.token), &[]).0, 200, "{target}");
        for wrong in ["", "token=", "token=0", &format!("token={watching}0")] {
            let (status, answer) = get(address, &format!("{target}{wrong}"), &[]);
            assert!(status == 403 && !answer.contains("channels") && !answer.contains("filename"), "{target} {wrong}");
        }
        let elsewhere = "Origin: https://evil.example.org";
        assert_eq!(get(address, &format!("{target}token={watching}"), &[elsewhere]).0, 403, "{target}");
        let request = format!("GET {target}token={watching} HTTP/1.1\r\nHost: evil.example.org\r\nConnection: close\r\n\r\n");
        assert_eq!(ask(address, &request).0, 403);
    }
}

#[test]
fn what_is_too_large_is_refused() {
    // 2^24 pixels and a row: never encoded, so that the film needs no colours.
    let (stage, newest) = stage(Some(frame(1, Film { width: 4096, height: 4097, ..Film::default() })));
    let (address, token) = (stage.address(), &stage.token);
    for file in ["exr", "png"] {
        let (status, answer) = get(address, &format!("/frame.{file}?token={token}"), &[]);
        assert!(status == 413 && answer.contains("16781312 pixels; accepted: 16777216"), "{answer}");
    }
    newest.put(frame(2, film([9, 4], true)));
    let target = format!("/values?x=0&y=0&token={token}");
    for (lines, status) in [
        ("Content-Length: 0\r\n", 200),
        ("Content-Length: 1\r\n", 413),
        ("Content-Length: 99999999999\r\n", 413),
        ("Transfer-Encoding: chunked\r\n", 413),
        (&format!("X-Long: {}\r\n", "a".repeat(20_000)), 431),
    ] {
        let found = ask(address, &format!("GET {target} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{lines}\r\n"));
        assert_eq!(found.0, status, "{} {}", lines.len(), found.1);
    }
    let (status, answer) = get(address, &format!("/values?x={}&y=0&token={token}", "9".repeat(8000)), &[]);
    assert!(status == 400 && answer.len() < 1000, "{answer}");
}

/// One who takes a file slowly keeps others from files for as long, and from nothing else.
#[test]
fn one_file_is_on_its_way_at_once() {
    let noise = |i: usize| (i as u32).wrapping_mul(2_654_435_761) as f32;
    let mut large = film([2048, 1024], true);
    // It cannot be compressed: no buffer of a socket takes all of it.
    large.rgba.iter_mut().enumerate().for_each(|(i, rgba)| *rgba = [noise(i), noise(i + 1), noise(i + 2), 1.0]);
    let (stage, _newest) = stage(Some(frame(1, large)));
    let (address, token) = (stage.address(), &stage.token);
    let mut slow = TcpStream::connect(address).unwrap();
    slow.set_read_timeout(Some(LIMIT)).unwrap();
    write!(slow, "GET /frame.exr?token={token} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    slow.read_exact(&mut [0; 64]).unwrap();
    let (status, answer) = get(address, &format!("/frame.json?token={token}"), &[]);
    assert!(status == 503 && answer.contains("another file is on its way"), "{answer}");
    // The picture without loss is made once for all pages, and waits for nobody.
    let [first, second] = [0, 1].map(|_| bytes(address, &format!("/frame.png?token={token}")).1);
    assert!(first.starts_with(b"\x89PNG") && first == second);
    assert_eq!(get(address, &format!("/values?x=0&y=0&token={token}"), &[]).0, 200);
    drop(slow);
    let end = Instant::now() + LIMIT;
    while get(address, &format!("/frame.json?token={token}"), &[]).0 == 503 {
        assert!(Instant::now() < end, "its place is free again");
    }
}

pub fn url(running: &Running) -> (SocketAddr, String) {
    until("an address", || running.stdout().contains('}'));
    let printed: Value = serde_json::Deserializer::from_str(&running.stdout()).into_iter().next().unwrap().unwrap();
    let (address, token) = printed["url"].as_str().unwrap().strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
    (address.parse().unwrap(), token.to_owned())
}

#[test]
fn a_run_tells_the_values_of_the_exr_that_it_writes() {
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
    let mut told = Vec::new();
    for pixel in 0..32 {
        let (status, answer) = get(address, &format!("/values?x={pixel}&y={}&token={token}", pixel / 2), &[]);
        assert_eq!(status, 200, "{answer}");
        told.push(serde_json::from_str::<Value>(body(&answer)).unwrap());
    }
    let (head, _) = bytes(address, &format!("/frame.json?token={token}"));
    assert!(head.contains("filename=\"gyre-frame-"), "{head}");
    running.signal(libc::SIGTERM);
    running.wait();
    for values in told {
        assert!(values["channels"]["error"].as_f64().unwrap() > 0.0, "{values}");
        let film = read_exr(&run.join(format!("frames/frame_{:06}.exr", values["frame"].as_u64().unwrap()))).unwrap();
        agrees(&values, &film);
    }
}

/// The field that a run traces beside itself is that of `ftle`.
#[test]
fn a_run_traces_the_field_of_its_slide() {
    let folder = tempfile::tempdir().unwrap();
    // Longer than the test, so that the slide stays.
    let lines = "time.tau = 2\ntime.frames_per_slide = 100000\nrender.method = \"two_level\"\nsurrogate.kind = \"table\"\n";
    let scene = scene::write(folder.path(), &double_gyre([16, 8, 1], lines));
    let endpoint = format!("ipc://{}", folder.path().join("frames").display());
    let mut replay = ridgewatch(["replay", &scene, "--json", "--out", text(&folder.path().join("gyre")), "--dashboard=0"]);
    let running = start(replay.args(["--publish", &endpoint]));
    let (address, token) = url(&running);
    let asked = |query: &str| bytes(address, &format!("/field.nc?{query}token={token}"));
    let (head, why) = asked("slide=0&");
    assert!(
        head.starts_with("HTTP/1.1 202") || (head.starts_with("HTTP/1.1 404") && why.starts_with(b"no frame is complete yet")),
        "{head}"
    );
    Visitor::open(address, &token).frame();
    let mut state = Vec::new();
    let (head, found) = loop {
        let (head, found) = asked("slide=0&");
        if !head.starts_with("HTTP/1.1 202") && !head.starts_with("HTTP/1.1 404") {
            break (head, found);
        }
        state.push(serde_json::from_slice::<Value>(&found).ok());
        // A second page is told of the first one's.
        let (_, other) = asked("slide=7&");
        let other = String::from_utf8_lossy(&other).into_owned();
        let is_told =
            ["the field of slide 0 is being traced", "slide 7 is no longer kept: the run shows slide 0", "no frame is complete yet"];
        assert!(is_told.iter().any(|words| other.contains(words)), "{other}");
        std::thread::sleep(std::time::Duration::from_millis(20));
    };
    assert!(
        head.starts_with("HTTP/1.1 200") && head.contains("filename=\"gyre-field-slide-0000.nc\""),
        "{head} {:?}",
        String::from_utf8(found)
    );
    let shares: Vec<f64> = state.iter().flatten().map(|state| state["share"].as_f64().unwrap()).collect();
    assert!(!shares.is_empty() && shares.is_sorted() && shares.iter().all(|share| (0.0..=1.0).contains(share)), "{state:?}");
    running.signal(libc::SIGTERM);
    running.wait();
    let [own, wanted] = ["own.nc", "wanted.nc"].map(|name| folder.path().join(name));
    std::fs::write(&own, found).unwrap();
    let values = |file: &Path, name: &str| netcdf::open(file).unwrap().variable(name).unwrap().get_values::<f64, _>(..).unwrap();
    let grid = format!("{}x{}", values(&own, "x").len(), values(&own, "y").len());
    assert_eq!(grid, "1024x512", "half a million seeds");
    run(&mut ridgewatch(["ftle", &scene, "--device", "cpu", "--grid", &grid, "--out", text(&wanted)])).success();
    for name in ["x", "y", "time", "time_bounds", "ftle", "lifetime", "ftle_error_of_steps", "integration_steps"] {
        assert_eq!(values(&own, name), values(&wanted, name), "{name}");
    }
}

/// A run beside a simulation has no window for most of the time: it has given up the last one and awaits the next.
#[test]
fn who_asks_between_two_slides_gets_the_next_one() {
    let mut setup = scene::setup(&scene::gated_turbulence("source.snapshots = 12\ntime.tau = 4"), &["time.slides=5"]);
    let newest = NewestSlide::new(&setup.plan);
    let index = |wanted| newest.get(wanted).map(|slide| slide.map(|slide| slide.index()));
    assert!(matches!(index(None), Err(NoField::Missing(_))));
    let mut next = || {
        let slide = setup.slides.next_slide(&AtomicBool::new(false)).unwrap().unwrap();
        let shown = ShownSlide { slide, map: setup.plan.map.clone(), asked: setup.plan.map.clone(), is_new: true, next: None };
        newest.put(&shown);
        shown
    };
    let shown = next();
    assert_eq!(index(Some(0)).unwrap(), Some(0));
    drop(shown);
    // Who wants this very slide is told; only who wants the newest one can be served later.
    assert!(matches!(index(Some(0)), Err(NoField::Gone(why)) if why.contains("reads the next one")));
    drop(next());
    assert_eq!(index(None).unwrap(), None, "nobody had asked");
    drop(next());
    drop(next());
    assert_eq!(index(None).unwrap(), Some(3));
    assert!(matches!(index(Some(3)), Err(NoField::Gone(_))), "it was kept for the one who asked");
    drop(next());
    assert_eq!(index(None).unwrap(), None);
}
