//! Mutated rings and messages: the parsers do not panic, and their memory stays below the stated limits. `RIDGEWATCH_MUTATIONS` sets the number of cases
//! (one million for the figures in docs/live.md).

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "support/counting.rs"]
mod counting;
#[path = "support/random.rs"]
mod random;
#[path = "support/sessions.rs"]
mod sessions;

use counting::{HELD, PEAK};
use random::{Random, cases};
use ridgewatch_wire::message::{ASK_BYTES, Ask, ConnectionFile, Facts, Key, Kind, Session};
use ridgewatch_wire::{
    AxisDescription, Description, Element, Field, Geometry, Limits, Policy, Producer, Read, ReadAt, RingReader, block_path,
};
use sessions::session;
use std::io::Cursor;

/// Most memory of one case: the step, the description and its parts, the text of an error.
const STEP_BYTES: u64 = 1 << 16;
const MEMORY: isize = STEP_BYTES as isize + (1 << 15);

/// Runs a case, and checks that it takes at most so many bytes.
fn within<T>(limit: isize, case: u64, run: impl FnOnce() -> T) -> T {
    let held = HELD.get();
    PEAK.set(held);
    let result = run();
    assert!(PEAK.get() - held <= limit, "case {case} took {} bytes", PEAK.get() - held);
    result
}

/// Changes bytes as damage and intent do: bits, extreme numbers, moved pieces, truncation.
fn mutate(bytes: &mut Vec<u8>, places: &[std::ops::Range<usize>], random: &mut Random) {
    const EDGES: [u64; 10] = [0, 1, 2, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 40, u64::MAX];
    for _ in 0..1 + random.below(4) {
        let range = places[random.below(places.len())].clone();
        let place = range.start + random.below(range.len());
        if place + 8 > bytes.len() {
            continue;
        }
        match random.below(8) {
            0 | 1 => bytes[place] ^= 1 << random.below(8),
            2 => bytes[place] = random.number() as u8,
            3 => bytes[place..place + 4].copy_from_slice(&(EDGES[random.below(10)] as u32).to_le_bytes()),
            4 => bytes[place..place + 8].copy_from_slice(&EDGES[random.below(10)].to_le_bytes()),
            5 => bytes[place..place + 8].copy_from_slice(&f64::from_bits(random.number()).to_le_bytes()),
            6 => {
                let from = (range.start + random.below(range.len().saturating_sub(8))).min(bytes.len());
                let length = 8.min(range.end.min(bytes.len()).saturating_sub(from));
                let to = place.min(bytes.len() - length);
                bytes.copy_within(from..from + length, to);
            }
            _ if random.below(4) == 0 => bytes.truncate(random.below(bytes.len())),
            _ => bytes[place] = bytes[place].wrapping_add(1),
        }
    }
}

/// Corrects a ring's checksum, so that mutations reach the checks behind it.
fn repair(bytes: &mut [u8]) {
    if bytes.len() < 8192 {
        return;
    }
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let Some(end) = 8192usize.checked_add(length).filter(|end| *end <= bytes.len()) else { return };
    let mix = |sum: u64, byte: &u8| (sum ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    let sum = bytes[..72].iter().chain(&bytes[8192..end]).fold(0xcbf2_9ce4_8422_2325, mix);
    bytes[72..80].copy_from_slice(&sum.to_le_bytes());
}

struct Bytes<'a>(&'a [u8]);

impl ReadAt for Bytes<'_> {
    fn length(&self) -> std::io::Result<u64> {
        Ok(self.0.len() as u64)
    }

    fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()> {
        let begin = usize::try_from(offset).ok().filter(|b| *b <= self.0.len()).ok_or(std::io::ErrorKind::UnexpectedEof)?;
        let from = self.0[begin..].get(..to.len()).ok_or(std::io::ErrorKind::UnexpectedEof)?;
        to.copy_from_slice(from);
        Ok(())
    }

    fn write_at(&self, _: &[u8], _: u64) -> std::io::Result<()> {
        Ok(())
    }
}

fn description() -> Description {
    let axis = |name, n| AxisDescription::uniform(name, "m", 0.0, 1.0, n);
    Description::whole(Geometry::Sphere { radius: 6.371e6 }, vec![axis("lon", 5), axis("lat", 4), axis("z", 3)], "s")
}

/// A ring with steps in it.
fn ring() -> Vec<u8> {
    let folder = std::path::PathBuf::from("/dev/shm").join(format!("rw-mutation-{}", std::process::id()));
    let producer = Producer::open(&folder, description(), 3, Policy::NewestWins).unwrap();
    let plane = [1.0f32; 60];
    let pointers = [plane.as_ptr().cast::<u8>(); 3];
    for n in 0..5 {
        // SAFETY: 60 values, as described.
        unsafe { producer.publish(n, n as f64, &Field::packed(&pointers, Element::F32, [5, 4, 3])).unwrap() };
    }
    std::fs::read(block_path(&folder, 0)).unwrap()
}

#[test]
fn mutated_rings() {
    let whole = ring();
    let length = u32::from_le_bytes(whole[12..16].try_into().unwrap()) as usize;
    let first = (8192 + length).div_ceil(4096) * 4096;
    // The header, the counts, the description and the heads of the slots.
    let places = [0..80, 8192..8192 + length, 8192..8192 + length, 1024..1048, first..first + 32, first + 4096..first + 4128];
    let limits = Limits { step_bytes: STEP_BYTES };
    let mut random = Random(1);
    let (mut refused, mut opened, mut read) = (0u64, 0u64, 0u64);
    let mut bytes = Vec::with_capacity(whole.len());
    for case in 0..cases() {
        bytes.clear();
        bytes.extend_from_slice(&whole);
        mutate(&mut bytes, &places, &mut random);
        if case % 4 != 0 {
            repair(&mut bytes);
        }
        within(MEMORY, case, || match RingReader::over("mutated".into(), Bytes(&bytes), &limits) {
            Err(error) => {
                assert!(!error.to_string().is_empty());
                refused += 1;
            }
            Ok(mut reader) => {
                opened += 1;
                let mut values = Vec::new();
                // One read more than there are slots.
                for _ in 0..4 {
                    match reader.read(&mut values) {
                        Ok(Read::Step(info)) => {
                            assert!(info.time.is_finite());
                            assert_eq!(values.len() as u64 * 4, reader.header().description.block_bytes());
                            read += 1;
                        }
                        Ok(_) | Err(_) => break,
                    }
                }
            }
        });
    }
    println!("{} mutated rings: {refused} refused, {opened} opened, {read} steps read", cases());
    assert!(refused > cases() / 4 && opened > cases() / 20 && read > opened, "{refused} {opened} {read}: the corpus is lopsided");
}

/// One end of a session without a socket.
struct Loop {
    incoming: Cursor<Vec<u8>>,
    outgoing: Vec<u8>,
}

impl std::io::Read for Loop {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        self.incoming.read(to)
    }
}

impl std::io::Write for Loop {
    fn write(&mut self, from: &[u8]) -> std::io::Result<usize> {
        self.outgoing.extend_from_slice(from);
        Ok(from.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn mutated_messages() {
    // Changed on the way, without the key. Malicious peers with the key are tested in src/message.rs.
    let (mut server, mut client) = session();
    let mut known: Option<Description> = None;
    let mut random = Random(2);
    let limits = Limits { step_bytes: STEP_BYTES };
    let values = vec![0.5f32; 180];
    let (mut refused, mut taken) = (0u64, 0u64);
    for case in 0..cases() {
        let facts = Facts { kind: Kind::Step, block: 0, generation: 1, step: case, time: case as f64, published: 0, missed: 0 };
        let mut bytes = Vec::with_capacity(4096);
        server.send(&mut bytes, &facts, Some(&description()), &values).unwrap();
        // One in eight arrives as it was sent.
        if case % 8 != 0 {
            let length = bytes.len();
            mutate(&mut bytes, &[0..108, 108..length - 700, length - 700..length], &mut random);
        }
        let mut to = Vec::new();
        let mut note = |_, announced: Option<Description>| {
            known = announced.or(known.take());
            known.as_ref().map(Description::block_bytes)
        };
        match within(MEMORY, case, || client.receive(&mut Cursor::new(&bytes), &limits, &mut note, &mut to)) {
            Ok(_) => taken += 1,
            Err(_) => refused += 1,
        }
    }
    println!("{} mutated messages: {refused} refused, {taken} taken", cases());
    // A mutation may leave a message as it was.
    assert!(taken >= cases() / 8 && refused > cases() * 3 / 4, "{refused} {taken}");
}

/// Requests that were changed on the way: only unchanged ones are accepted, and only once.
#[test]
fn mutated_asks() {
    let (mut relay, mut follower) = session();
    let mut random = Random(4);
    let (mut refused, mut taken) = (0u64, 0u64);
    for case in 0..cases() {
        let mut sent = Vec::with_capacity(ASK_BYTES);
        follower.ask(&mut sent, if case % 2 == 0 { Ask::Next } else { Ask::Hold }).unwrap();
        let mut bytes = sent.clone();
        if case % 8 != 0 {
            mutate(&mut bytes, &[0..20, 0..ASK_BYTES], &mut random);
            bytes.resize(ASK_BYTES, 0);
        }
        let bytes: [u8; ASK_BYTES] = bytes.try_into().unwrap();
        let found = within(1 << 12, case, || relay.check_ask(&bytes));
        assert_eq!(found.is_ok(), bytes == *sent, "case {case}: {found:?}");
        if found.is_ok() {
            assert!(relay.check_ask(&bytes).is_err(), "case {case} was taken twice");
            taken += 1;
        } else {
            refused += 1;
        }
    }
    println!("{} mutated asks: {refused} refused, {taken} taken", cases());
    assert!(taken >= cases() / 8 && refused > cases() * 3 / 4, "{refused} {taken}");
}

#[test]
fn mutated_connection_files() {
    let good = format!("ridgewatch-connection = 1\naddress = node17:40123\nkey = {}\n", "0123456789abcdef".repeat(4));
    assert!(good.parse::<ConnectionFile>().is_ok());
    let mut random = Random(5);
    let (mut refused, mut taken) = (0u64, 0u64);
    for case in 0..cases() {
        let mut bytes = good.clone().into_bytes();
        let length = bytes.len();
        mutate(&mut bytes, &[0..length, 24..length], &mut random);
        // Reading the file refuses text that is not UTF-8.
        let text = String::from_utf8_lossy(&bytes).into_owned();
        within(1 << 12, case, || match text.parse::<ConnectionFile>() {
            Ok(file) => {
                taken += 1;
                assert!(file.address.len() < length);
            }
            Err(error) => {
                refused += 1;
                assert!(!error.to_string().is_empty());
            }
        });
    }
    println!("{} mutated connection files: {refused} refused, {taken} taken", cases());
    assert!(refused > cases() / 2 && taken > cases() / 100, "{refused} {taken}");
}

#[test]
fn mutated_greetings() {
    let key = Key::random().unwrap();
    // A follower's greeting; it cannot fit the relay's new random numbers, so it is never accepted.
    let mut asked = Loop { incoming: Cursor::new(Vec::new()), outgoing: Vec::new() };
    assert!(Session::accept(&mut asked, &key).is_err(), "there is no peer");
    // The first bytes equal those of the relay's greeting.
    let mut good = asked.outgoing[..16].to_vec();
    good.extend([9; 64]);
    let (mut random, mut unsigned) = (Random(3), 0);
    for case in 0..cases().min(100_000) {
        let mut bytes = good.clone();
        mutate(&mut bytes, &[0..16, 16..80], &mut random);
        let mut stream = Loop { incoming: Cursor::new(bytes), outgoing: Vec::with_capacity(256) };
        let refused = within(8192, case, || Session::accept(&mut stream, &key)).err().unwrap();
        unsigned += u64::from(matches!(refused, ridgewatch_wire::WireError::Signature));
    }
    println!("{} mutated greetings: all refused, {unsigned} of them for their signature", cases().min(100_000));
    // The others are refused earlier, for their first bytes.
    assert!(unsigned > cases().min(100_000) / 10, "{unsigned}");
}
