//! Greetings, requests, messages and connection files of any bytes are taken or refused: no panic, no memory beyond the limit.
#![no_main]

mod support;

use libfuzzer_sys::fuzz_target;
use ridgewatch_wire::message::{ASK_BYTES, Ask, ConnectionFile, Facts, Key, Kind, Session};
use ridgewatch_wire::{AxisDescription, Description, Geometry, Limits};
use std::io::{Cursor, Read, Result, Write};
use std::os::unix::net::UnixStream;
use std::sync::{Mutex, OnceLock};

/// Bytes of the largest step that is received.
const STEP_BYTES: u64 = 1 << 16;

/// One end of a connection whose other end says what was fuzzed, and hears nothing.
struct Peer<'a>(Cursor<&'a [u8]>);

impl Read for Peer<'_> {
    fn read(&mut self, to: &mut [u8]) -> Result<usize> {
        self.0.read(to)
    }
}

impl Write for Peer<'_> {
    fn write(&mut self, from: &[u8]) -> Result<usize> {
        Ok(from.len())
    }

    fn flush(&mut self) -> Result<()> {
        Ok(())
    }
}

fn key() -> &'static Key {
    static KEY: OnceLock<Key> = OnceLock::new();
    KEY.get_or_init(|| Key::random().expect("random numbers"))
}

/// Both ends of a session: the relay's and the follower's.
fn session() -> (Session, Session) {
    let (mut ours, mut theirs) = UnixStream::pair().expect("sockets");
    let follower = std::thread::spawn(move || Session::connect(&mut theirs, key()).expect("a session"));
    (Session::accept(&mut ours, key()).expect("a session"), follower.join().expect("a session"))
}

fn receive(session: &mut Session, bytes: &[u8]) -> Option<(Facts, Vec<f32>)> {
    let (mut known, mut values) = (None, Vec::new());
    let mut note = |_, announced: Option<Description>| {
        known = announced.or(known.take());
        known.as_ref().map(Description::block_bytes)
    };
    let facts = session.receive(&mut Cursor::new(bytes), &Limits { step_bytes: STEP_BYTES }, &mut note, &mut values).ok();
    assert!(values.capacity() as u64 * 4 <= 2 * STEP_BYTES);
    facts.map(|facts| (facts, values))
}

/// A description that a peer with the key may announce.
fn described(input: &[u8]) -> Description {
    let mut input = input.iter().copied();
    let mut number = || f64::from_le_bytes(std::array::from_fn(|_| input.next().unwrap_or(0)));
    let radius = number();
    let geometry = if radius == 0.0 { Geometry::Cartesian } else { Geometry::Sphere { radius } };
    let axes = 1 + number().to_bits() % 4;
    let axis = |_| {
        let nodes = number().to_bits() % 64;
        let coordinates = (0..nodes).map(|_| number()).collect();
        AxisDescription { name: "x".into(), unit: String::new(), coordinates, period: Some(number()).filter(|period| *period != 0.0) }
    };
    let axes = (0..axes).map(axis).collect();
    Description::whole(geometry, axes, "s")
}

fuzz_target!(|input: &[u8]| {
    static SESSION: OnceLock<Mutex<(Session, Session)>> = OnceLock::new();
    let Some((kind, rest)) = input.split_first() else { return };
    if kind % 6 == 0 {
        let _ = Session::accept(&mut Peer(Cursor::new(rest)), key());
        return;
    }
    if kind % 6 == 1 {
        let _ = Session::connect(&mut Peer(Cursor::new(rest)), key());
        return;
    }
    if kind % 6 == 2 {
        if let Ok(text) = str::from_utf8(rest) {
            let _ = text.parse::<ConnectionFile>();
        }
        return;
    }
    let mut ends = SESSION.get_or_init(|| Mutex::new(session())).lock().expect("no panic before");
    let (relay, follower) = &mut *ends;
    let facts = Facts { kind: Kind::Step, block: 0, generation: 1, step: 2, time: 3.0, published: 4, missed: 0 };
    let mut sent = Vec::new();
    match kind % 6 {
        3 => {
            follower.ask(&mut sent, Ask::Next).expect("a vector");
            let mut bytes = support::file(&sent, rest);
            bytes.resize(ASK_BYTES, 0);
            let taken = relay.check_ask(bytes.as_slice().try_into().expect("its length"));
            // Other bytes may be a request of an earlier input that did not arrive: the fuzzer sees what signatures are compared with.
            assert!(taken.is_ok() || bytes != sent);
        }
        4 => {
            let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 4);
            let description = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
            relay.send(&mut sent, &facts, Some(&description), &[0.5; 32]).expect("a vector");
            let bytes = support::file(&sent, rest);
            let taken = receive(follower, &bytes);
            assert!(taken.is_some() || !bytes.starts_with(&sent));
        }
        _ => {
            // Signed, so that everything behind the signature is reached.
            let description = described(rest);
            let values = vec![0.5; (description.block_bytes() / 4).min(1 << 14) as usize];
            if relay.send(&mut sent, &facts, Some(&description), &values).is_ok()
                && let Some((_, received)) = receive(follower, &sent)
            {
                assert_eq!(received, values);
            }
        }
    }
});
