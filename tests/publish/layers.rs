//! All layers of frames, for those who ask for them by name.

use crate::kit::program::until;
use crate::kit::publishing::{self, GREETING, READY};
use ridgewatch::publish::{FRAME_TOPIC, FrameHeader, LAYERS_TOPIC, MapAbout, Payload, PublishSettings, Publisher, RunAbout, decode_exr};
use ridgewatch::render::Film;
use ridgewatch::run::{Frame, FrameRecord};
use ridgewatch::trust::Gate;
use ridgewatch_zmtp::Subscriber;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Longer than anything here takes on a busy machine, so that a test that hangs fails.
const LIMIT: Duration = Duration::from_secs(120);

/// A film that cannot be compressed.
fn film([width, height]: [usize; 2]) -> Arc<Film> {
    let noise = |i: usize| f32::from_bits((i as u32).wrapping_mul(2_654_435_761) >> 2 | 0x2000_0000);
    let pixels = width * height;
    let rgba = (0..pixels).map(|i| std::array::from_fn(|k| noise(4 * i + k))).collect();
    Arc::new(Film { rgba, ftle_mean: (0..pixels).map(noise).collect(), ..Film::new(width, height) })
}

fn frame(number: u64, film: &Arc<Film>) -> Frame {
    let record = FrameRecord { frame: number, size: [film.width, film.height], ..Default::default() };
    let gate = Gate::new([2, 1, 1], vec![true, false]);
    Frame { gate: Some(Arc::new(gate)), ..publishing::frame(record, Arc::clone(film)) }
}

fn publisher(settings: PublishSettings) -> Publisher {
    Publisher::start("tcp://127.0.0.1:0", &PublishSettings { payload: Payload::Jpeg, ..settings }).unwrap()
}

/// Publishes frames at an interval, and tells the number of the newest, while `work` is done.
fn while_published<T>(publisher: &Publisher, film: &Arc<Film>, interval: Duration, work: impl FnOnce(&AtomicU64) -> T) -> T {
    let (ends, newest) = (AtomicBool::new(false), AtomicU64::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for number in 0.. {
                publisher.frame(frame(number, film));
                newest.store(number, Ordering::Relaxed);
                if ends.load(Ordering::Relaxed) {
                    return;
                }
                std::thread::sleep(interval);
            }
        });
        let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| work(&newest)));
        ends.store(true, Ordering::Relaxed);
        done.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap()
}

async fn subscribe(publisher: &Publisher, topic: &str) -> Subscriber {
    Subscriber::connect(publisher.endpoint(), &[topic], 1 << 30).await.unwrap()
}

/// Header and payload of the next message of a topic.
async fn next(subscriber: &mut Subscriber, topic: &str) -> (FrameHeader, bytes::Bytes) {
    loop {
        let parts = tokio::time::timeout(LIMIT, subscriber.receive()).await.expect("a message in time").unwrap();
        if parts[0] == topic {
            return (serde_json::from_slice(&parts[1]).unwrap(), parts[2].clone());
        }
    }
}

#[test]
fn layers_are_made_while_somebody_names_them_and_once_a_second() {
    let (publisher, film, runtime) = (publisher(PublishSettings::default()), film([24, 16]), runtime());
    publisher.describe(&RunAbout::new(Path::new("out/gulf"), MapAbout::default()));
    let made = || publisher.statistics().layers;
    while_published(&publisher, &film, Duration::from_millis(20), |_| {
        // Who subscribes to all topics does not know of this one.
        let mut all = runtime.block_on(subscribe(&publisher, ""));
        runtime.block_on(next(&mut all, FRAME_TOPIC));
        std::thread::sleep(Duration::from_millis(1500));
        assert_eq!(made(), 0, "nobody has asked");
        let (mut named, begin) = (runtime.block_on(subscribe(&publisher, LAYERS_TOPIC)), Instant::now());
        let mut last = None;
        for _ in 0..3 {
            let (header, exr) = runtime.block_on(next(&mut named, LAYERS_TOPIC));
            assert!(last < Some(header.frame), "{last:?} {}", header.frame);
            last = Some(header.frame);
            assert_eq!((header.encoding, header.payload_bytes, header.shape), (Payload::Exr, exr.len(), [16, 24, 4]));
            assert_eq!(header.record, *frame(header.frame, &film).record);
            let decoded = decode_exr(&exr).unwrap();
            assert!(decoded.rgba == film.rgba && decoded.ftle_mean == film.ftle_mean);
            let told = RunAbout::told(header.about.as_ref());
            assert_eq!((told.run(), header.trusted.unwrap().gate().unwrap().cells()), ("gulf", &[true, false][..]));
        }
        assert!(begin.elapsed() >= Duration::from_secs(2), "three in {:?}", begin.elapsed());
        drop(named);
        // One may be on its way.
        std::thread::sleep(Duration::from_millis(1500));
        let before = made();
        std::thread::sleep(Duration::from_millis(2500));
        assert_eq!(made(), before, "nobody asks any more");
    });
    // No frame follows; who comes now gets the layers of the newest.
    let newest = publisher.statistics().frames - 1;
    for _ in 0..2 {
        let mut late = runtime.block_on(subscribe(&publisher, LAYERS_TOPIC));
        assert_eq!(runtime.block_on(next(&mut late, LAYERS_TOPIC)).0.frame, newest);
    }
    let before = made();
    std::thread::sleep(Duration::from_millis(2500));
    assert_eq!(made(), before);
    publisher.finish(LIMIT);
}

/// One that subscribes to layers and never reads.
fn stalled(publisher: &Publisher) -> TcpStream {
    let mut stream = TcpStream::connect(publisher.endpoint().strip_prefix("tcp://").unwrap()).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    stream.write_all(&GREETING).unwrap();
    stream.read_exact(&mut GREETING.to_owned()).unwrap();
    stream.write_all(READY).unwrap();
    let mut head = [0; 2];
    stream.read_exact(&mut head).unwrap();
    stream.read_exact(&mut vec![0; usize::from(head[1])]).unwrap();
    stream.write_all(b"\x00\x07\x01layers").unwrap();
    stream
}

/// It holds two messages, as many as may be in flight: none of them is a picture. And with a third place others get layers too.
#[test]
fn who_does_not_read_layers_delays_neither_pictures_nor_the_layers_of_others() {
    let (film, runtime) = (film([1024, 512]), runtime());
    for (topic, frames_in_flight) in [(FRAME_TOPIC, 2), (LAYERS_TOPIC, 3)] {
        let publisher = publisher(PublishSettings { frames_in_flight, stall_seconds: LIMIT.as_secs_f64(), ..Default::default() });
        while_published(&publisher, &film, Duration::from_millis(50), |newest| {
            let mut healthy = runtime.block_on(subscribe(&publisher, topic));
            let first = runtime.block_on(next(&mut healthy, topic)).0.frame;
            let _stuck = stalled(&publisher);
            let (before, begin) = (publisher.statistics().layers, Instant::now());
            until("it holds two", || publisher.statistics().layers >= before + 2);
            let mut last = first;
            for _ in 0..4 {
                let late = Instant::now();
                last = runtime.block_on(next(&mut healthy, topic)).0.frame;
                // A sixteenth of the patience with it.
                assert!(late.elapsed() < LIMIT / 16, "{topic}: frame {last} came after {:?}", late.elapsed());
            }
            assert!(newest.load(Ordering::Relaxed) >= last && last > first, "{topic} {first} {last}");
            let statistics = publisher.statistics();
            assert_eq!(statistics.stall_disconnects, 0, "{topic} in {:?}: {statistics:?}", begin.elapsed());
        });
        publisher.finish(Duration::ZERO);
    }
}
