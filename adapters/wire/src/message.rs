//! Signed messages between nodes, over TCP.
//!
//! Both sides know the key of a [`ConnectionFile`]. They exchange random numbers, prove the key, and derive a session key from the numbers and the key, so that
//! a message of another session never verifies. A message is a head of fixed length with its signature (HMAC-SHA256), the description of an opened block, the
//! values, and a signature of the head and the BLAKE3 hash of description and values. The second signature comes last, so that hashing overlaps sending.
//! Message numbers rise strictly within a session. No memory is allocated before the head is verified, and no content is used before the second signature is.
//! The follower requests each message except pulses (also signed and numbered), so that nothing is sent to a follower that does not read.
//!
//! The transport is TCP, not ZeroMQ: the `zeromq` crate allocates any length that a peer announces, before a signature can be checked, and is half as fast
//! with steps of 340 MB (`benches/relay.rs`).

use crate::bytes::{PIECE, Parser, Writer, fill};
use crate::header::DESCRIPTION_BYTES;
use crate::private::{create_private, open_private};
use crate::{Description, Limits, WireError, system};
use hmac::{Hmac, Mac};
use sha2::Sha256;
use std::io::{ErrorKind, Read, Write};
use std::path::Path;
use std::str::FromStr;

#[cfg(target_endian = "big")]
compile_error!("rings and messages are little-endian and are not converted");

/// First bytes of either greeting.
const GREETING: [u8; 12] = *b"RIDGEWIRE\0\0\0";
/// First bytes of a message.
const MAGIC: [u8; 4] = *b"RWMS";
/// First bytes of a request.
const ASK_MAGIC: [u8; 4] = *b"RWAS";
const VERSION: u32 = 4;
/// Bytes of a request, with its signature.
pub const ASK_BYTES: usize = 20 + SIGNATURE;
/// Bytes of a message's head, and of a signature.
const HEAD: usize = 76;
const SIGNATURE: usize = 32;
/// Most bytes of a connection file.
const MAX_FILE_BYTES: u64 = 4096;

/// Secret that both sides share.
#[derive(Clone, PartialEq, Eq)]
pub struct Key([u8; 32]);

impl std::fmt::Debug for Key {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str("Key(..)")
    }
}

impl Key {
    /// A new random key.
    ///
    /// # Errors
    /// The system returns no random numbers.
    pub fn random() -> Result<Self, WireError> {
        system::random().map(Self).map_err(|e| WireError::io(Path::new("getrandom"), "no random numbers", e))
    }

    fn sign(&self, parts: &[&[u8]]) -> Hmac<Sha256> {
        let Ok(mut mac) = Hmac::<Sha256>::new_from_slice(&self.0) else { unreachable!("HMAC takes keys of any length") };
        parts.iter().for_each(|part| mac.update(part));
        mac
    }

    /// HMAC-SHA256 of the parts, one after the other.
    pub fn signature(&self, parts: &[&[u8]]) -> [u8; SIGNATURE] {
        self.sign(parts).finalize().into_bytes().into()
    }

    /// Another key, from this one and the parts.
    pub fn derive(&self, parts: &[&[u8]]) -> Self {
        Self(self.signature(parts))
    }

    /// Compares with [`Self::signature`].
    ///
    /// # Errors
    /// [`WireError::Signature`] if it is another one.
    pub fn verify(&self, parts: &[&[u8]], signature: &[u8; SIGNATURE]) -> Result<(), WireError> {
        // Compares in constant time.
        self.sign(parts).verify_slice(signature).map_err(|_| WireError::Signature)
    }
}

/// Address of a relay or of a command socket, and its key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionFile {
    /// `HOST:PORT`, or the endpoint of a command socket.
    pub address: String,
    /// The shared key.
    pub key: Key,
}

impl ConnectionFile {
    /// Writes the file with mode 0600, and replaces an existing one.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), WireError> {
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = Path::new(&part);
        let _ = std::fs::remove_file(part);
        let hex: String = self.key.0.iter().map(|byte| format!("{byte:02x}")).collect();
        let text = format!("ridgewatch-connection = 1\naddress = {}\nkey = {hex}\n", self.address);
        let mut file = create_private(part, true).map_err(|e| WireError::io(part, "cannot be created", e))?;
        file.write_all(text.as_bytes()).map_err(|e| WireError::io(part, "cannot be written", e))?;
        std::fs::rename(part, path).map_err(|e| WireError::io(path, "cannot be renamed into place", e))
    }

    /// Removes the file if it is still this one: another relay may have replaced it.
    pub fn remove(&self, path: &Path) {
        if Self::read(path).is_ok_and(|found| found == *self) {
            let _ = std::fs::remove_file(path);
        }
    }

    /// Reads the file.
    ///
    /// # Errors
    /// The file does not belong to this user alone, or is no connection file.
    pub fn read(path: &Path) -> Result<Self, WireError> {
        let file = open_private(path, false)?;
        let mut text = String::new();
        file.take(MAX_FILE_BYTES).read_to_string(&mut text).map_err(|e| WireError::io(path, "cannot be read", e))?;
        text.parse()
    }
}

impl FromStr for ConnectionFile {
    type Err = WireError;

    fn from_str(text: &str) -> Result<Self, WireError> {
        let value = |key: &'static str| {
            let line = text.lines().find_map(|line| line.strip_prefix(key)?.trim_start().strip_prefix('='));
            line.map(str::trim).ok_or_else(|| WireError::field(key, "missing", "a connection file as ridgewatch writes it"))
        };
        let version = value("ridgewatch-connection")?;
        if version != "1" {
            return Err(WireError::Version { what: "the connection file", found: version.parse().unwrap_or(0), known: 1 });
        }
        let address = value("address")?.to_owned();
        let hex = value("key")?.as_bytes();
        let digit = |c: u8| (c as char).to_digit(16).map(|d| d as u8);
        let mut key = [0; 32];
        let bad = || WireError::field("key", format_args!("{} characters", hex.len()), "64 hexadecimal digits");
        if hex.len() != 64 {
            return Err(bad());
        }
        for (byte, pair) in key.iter_mut().zip(hex.as_chunks::<2>().0) {
            *byte = digit(pair[0]).zip(digit(pair[1])).map(|(high, low)| high * 16 + low).ok_or_else(bad)?;
        }
        Ok(Self { address, key: Key(key) })
    }
}

/// Kind of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A step of one block.
    Step = 1,
    /// The producer of a block has closed it.
    Ended,
    /// Heartbeat of the relay.
    Pulse,
    /// A producer has opened a block, perhaps before the session began. The message contains its description.
    Opened,
    /// The process of a block's producer has ended without closing it.
    Lost,
}

impl Kind {
    const ALL: [Self; 5] = [Self::Step, Self::Ended, Self::Pulse, Self::Opened, Self::Lost];
}

/// Request of a follower.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ask {
    /// Asks for the next message.
    Next = 1,
    /// Heartbeat of the follower. An open request stays open.
    Hold,
}

/// Content of a message's head. A step's values follow it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Facts {
    /// Kind of the message.
    pub kind: Kind,
    /// Index of the block.
    pub block: u32,
    /// Time of the opening, nanoseconds since 1970.
    pub generation: u64,
    /// The solver's number.
    pub step: u64,
    /// The solver's time.
    pub time: f64,
    /// Time of publication, nanoseconds since 1970.
    pub published: u64,
    /// Steps of the block since the last one that were overwritten before the relay read them.
    pub missed: u64,
}

/// One side's end of a session.
pub struct Session {
    key: Key,
    /// Number of the newest message that was sent or received.
    number: u64,
    /// Number of the newest request.
    asked: u64,
}

impl Session {
    /// `nonces`: the relay's and the follower's.
    fn begin(key: &Key, nonces: [&[u8; 32]; 2]) -> Self {
        Self { key: key.derive(&[b"session", nonces[0], nonces[1]]), number: 0, asked: 0 }
    }

    /// Accepts a follower, as the relay.
    ///
    /// # Errors
    /// The peer has another key or speaks another protocol, or the connection broke.
    pub fn accept(stream: &mut (impl Read + Write), key: &Key) -> Result<Self, WireError> {
        Self::accept_if(stream, key, || Ok(()))
    }

    /// [`Self::accept`] that may reject a follower with the right key: `admit` is called before the relay signs, so that the follower notices.
    ///
    /// # Errors
    /// Those of [`Session::accept`], and those of `admit`.
    pub fn accept_if(
        stream: &mut (impl Read + Write),
        key: &Key,
        admit: impl FnOnce() -> Result<(), WireError>,
    ) -> Result<Self, WireError> {
        let mine = system::random().map_err(WireError::connection)?;
        write(stream, &greeting(&mine))?;
        let theirs = read_greeting(stream)?;
        key.verify(&[b"follower", &mine, &theirs], &read(stream)?)?;
        admit()?;
        write(stream, &key.signature(&[b"relay", &mine, &theirs]))?;
        Ok(Self::begin(key, [&mine, &theirs]))
    }

    /// Connects to a relay, as the follower.
    ///
    /// # Errors
    /// Those of [`Session::accept`].
    pub fn connect(stream: &mut (impl Read + Write), key: &Key) -> Result<Self, WireError> {
        let mine = system::random().map_err(WireError::connection)?;
        let theirs = read_greeting(stream)?;
        write(stream, &greeting(&mine))?;
        write(stream, &key.signature(&[b"follower", &theirs, &mine]))?;
        let mut signature = [0; SIGNATURE];
        stream.read_exact(&mut signature).map_err(|e| match e.kind() {
            ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset => WireError::Rejected,
            _ => WireError::connection(e),
        })?;
        key.verify(&[b"relay", &theirs, &mine], &signature)?;
        Ok(Self::begin(key, [&theirs, &mine]))
    }

    /// Sends a request, as the follower.
    ///
    /// # Errors
    /// The connection broke.
    pub fn ask(&mut self, to: &mut impl Write, ask: Ask) -> Result<(), WireError> {
        self.asked += 1;
        let mut out = Writer(ASK_MAGIC.to_vec());
        out.u32(VERSION);
        out.u64(self.asked);
        out.u32(ask as u32);
        let signature = self.key.signature(&[&out.0]);
        out.0.extend_from_slice(&signature);
        write(to, &out.0)
    }

    /// Verifies a request, as the relay.
    ///
    /// # Errors
    /// A wrong key, or a changed or replayed request. The session is over then.
    pub fn check_ask(&mut self, bytes: &[u8; ASK_BYTES]) -> Result<Ask, WireError> {
        let Some((head, signature)) = bytes.split_last_chunk() else { unreachable!("a request is longer than its signature") };
        self.key.verify(&[head], signature)?;
        let mut input = Parser::new("a request", head);
        let magic: [u8; 4] = input.array()?;
        if magic != ASK_MAGIC {
            return Err(WireError::field("magic", format_args!("{magic:02x?}"), "a request of a follower"));
        }
        input.version(VERSION)?;
        let number = input.u64()?;
        if number <= self.asked {
            return Err(WireError::Replayed { found: number, newest: self.asked });
        }
        let ask = match input.u32()? {
            1 => Ask::Next,
            2 => Ask::Hold,
            other => return Err(WireError::field("ask", other, "1 (next) or 2 (hold)")),
        };
        self.asked = number;
        Ok(ask)
    }

    /// Sends a message, with a `description` if a block was opened and `values` if it is a step.
    ///
    /// # Errors
    /// The connection broke, the peer does not read, or there is no memory.
    pub fn send(&mut self, to: &mut impl Write, facts: &Facts, description: Option<&Description>, values: &[f32]) -> Result<(), WireError> {
        let description = description.map(Description::encode).transpose()?.unwrap_or_default();
        // SAFETY: f32 values have no padding.
        let values = unsafe { std::slice::from_raw_parts(values.as_ptr().cast::<u8>(), size_of_val(values)) };
        self.number += 1;
        let mut head = Writer(MAGIC.to_vec());
        head.u32(VERSION);
        head.u64(self.number);
        head.u32(facts.kind as u32);
        head.u32(facts.block);
        head.u64(facts.generation);
        head.u64(facts.step);
        head.f64(facts.time);
        head.u64(facts.published);
        head.u64(facts.missed);
        head.u32(description.len() as u32);
        head.u64(values.len() as u64);
        write(to, &head.0)?;
        write(to, &self.key.signature(&[&head.0]))?;
        let mut hasher = blake3::Hasher::new();
        for piece in std::iter::once(description.as_slice()).chain(values.chunks(PIECE)) {
            hasher.update(piece);
            write(to, piece)?;
        }
        let signature = self.key.signature(&[&head.0, hasher.finalize().as_bytes()]);
        to.write_all(&signature).and_then(|()| to.flush()).map_err(WireError::connection)
    }

    /// Receives a message. `known` gets its block and its description, if any, and returns the bytes of a step of that block; its arguments are valid only
    /// if this function succeeds. A step's values are in `values`, which keeps its memory from call to call.
    ///
    /// # Errors
    /// A wrong key, a changed or replayed message, wrong lengths, a field larger than `limits`, or no memory. The session is over then.
    pub fn receive(
        &mut self,
        from: &mut impl Read,
        limits: &Limits,
        known: &mut dyn FnMut(u32, Option<Description>) -> Option<u64>,
        values: &mut Vec<f32>,
    ) -> Result<Facts, WireError> {
        let head: [u8; HEAD] = read(from)?;
        self.key.verify(&[&head], &read(from)?)?;
        let (facts, description_bytes, payload) = self.check_head(&head)?;
        let mut hasher = blake3::Hasher::new();
        let mut description = vec![0; description_bytes as usize];
        from.read_exact(&mut description).map_err(WireError::connection)?;
        hasher.update(&description);
        let announced = (description_bytes > 0).then(|| Description::decode(&description, limits)).transpose()?;
        if let Some(announced) = &announced
            && announced.block.index != facts.block
        {
            let found = format!("its description says block {}", announced.block.index);
            return Err(WireError::Block { block: facts.block, found, accepted: "its own number".into() });
        }
        let bytes = known(facts.block, announced);
        let expected = if facts.kind == Kind::Step { bytes } else { Some(0) };
        if expected != Some(payload) || payload > limits.step_bytes {
            let accepted = expected.map_or("a description first".to_owned(), |bytes| format!("{bytes}, as described"));
            return Err(WireError::field("payload bytes", payload, accepted));
        }
        let count = payload as usize / 4;
        fill(values, count, |piece| {
            from.read_exact(piece).map_err(WireError::connection)?;
            hasher.update(piece);
            Ok(true)
        })?;
        self.key.verify(&[&head, hasher.finalize().as_bytes()], &read(from)?).map_err(|_| WireError::Payload)?;
        Ok(facts)
    }

    /// Decodes a head whose signature is verified.
    fn check_head(&mut self, head: &[u8; HEAD]) -> Result<(Facts, u32, u64), WireError> {
        let mut input = Parser::new("a message", head);
        let magic: [u8; 4] = input.array()?;
        if magic != MAGIC {
            return Err(WireError::field("magic", format_args!("{magic:02x?}"), "a message of a relay"));
        }
        input.version(VERSION)?;
        let number = input.u64()?;
        if number <= self.number {
            return Err(WireError::Replayed { found: number, newest: self.number });
        }
        let number_of_kind = input.u32()?;
        let Some(kind) = Kind::ALL.into_iter().find(|kind| *kind as u32 == number_of_kind) else {
            return Err(WireError::field("kind", number_of_kind, "1 (step), 2 (ended), 3 (pulse), 4 (opened) or 5 (lost)"));
        };
        let (block, generation, step, time) = (input.u32()?, input.u64()?, input.u64()?, input.f64()?);
        let (published, missed) = (input.u64()?, input.u64()?);
        if !time.is_finite() {
            return Err(WireError::field("time", time, "a finite number"));
        }
        let (description, payload) = (input.u32()?, input.u64()?);
        if description > DESCRIPTION_BYTES {
            return Err(WireError::TooLarge { what: "the description", needed: description.into(), limit: DESCRIPTION_BYTES.into() });
        }
        input.end()?;
        self.number = number;
        Ok((Facts { kind, block, generation, step, time, published, missed }, description, payload))
    }
}

fn write(to: &mut impl Write, bytes: &[u8]) -> Result<(), WireError> {
    to.write_all(bytes).map_err(WireError::connection)
}

fn read<const N: usize>(from: &mut impl Read) -> Result<[u8; N], WireError> {
    let mut bytes = [0; N];
    from.read_exact(&mut bytes).map_err(WireError::connection)?;
    Ok(bytes)
}

fn greeting(nonce: &[u8; 32]) -> Vec<u8> {
    let mut out = Writer(GREETING.to_vec());
    out.u32(VERSION);
    out.0.extend_from_slice(nonce);
    out.0
}

fn read_greeting(from: &mut impl Read) -> Result<[u8; 32], WireError> {
    let bytes: [u8; 48] = read(from)?;
    let mut input = Parser::new("the greeting", &bytes);
    let found: [u8; 12] = input.array()?;
    if found != GREETING {
        return Err(WireError::field("greeting", format_args!("{found:02x?}"), "that of a ridgewatch relay or follower"));
    }
    input.version(VERSION)?;
    input.array()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::counting::{HELD, PEAK};
    use crate::random::{Random, cases};
    use crate::{AxisDescription, Geometry};
    use std::io::Cursor;

    /// Bytes that a peer sends, and bytes that it receives.
    struct Peer(Cursor<Vec<u8>>, Vec<u8>);

    impl Read for Peer {
        fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
            self.0.read(to)
        }
    }

    impl Write for Peer {
        fn write(&mut self, from: &[u8]) -> std::io::Result<usize> {
            self.1.write(from)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn another_version_is_refused_by_name_in_greeting_message_and_ask() {
        let key = Key([1; 32]);
        let session = || Session { key: key.clone(), number: 0, asked: 0 };
        // Signed with the session's key, so that only the version is wrong.
        let older = |mut bytes: Vec<u8>, head: usize| {
            bytes[4..8].copy_from_slice(&1u32.to_le_bytes());
            let signature = key.signature(&[&bytes[..head]]);
            bytes[head..head + SIGNATURE].copy_from_slice(&signature);
            bytes
        };
        let mut greeted = greeting(&[7; 32]);
        greeted[12..16].copy_from_slice(&1u32.to_le_bytes());
        let peer = || Peer(Cursor::new(greeted.clone()), Vec::new());
        let (mut message, mut ask) = (Vec::new(), Vec::new());
        let facts = Facts { kind: Kind::Pulse, block: 0, generation: 1, step: 2, time: 3.0, published: 4, missed: 0 };
        session().send(&mut message, &facts, None, &[]).unwrap();
        session().ask(&mut ask, Ask::Next).unwrap();
        let message = older(message, HEAD);
        let ask: [u8; ASK_BYTES] = older(ask, ASK_BYTES - SIGNATURE).try_into().unwrap();
        let received = session().receive(&mut Cursor::new(message), &Limits::default(), &mut |_, _| None, &mut Vec::new());
        for (found, what) in [
            (Session::accept(&mut peer(), &key).err(), "the greeting"),
            (Session::connect(&mut peer(), &key).err(), "the greeting"),
            (received.err(), "a message"),
            (session().check_ask(&ask).err(), "a request"),
        ] {
            let error = found.unwrap();
            assert!(matches!(error, WireError::Version { what: w, found: 1, known: VERSION } if w == what), "{what}: {error}");
            assert_eq!(error.to_string(), format!("{what} has version 1; only version 4 is supported"));
        }
    }

    /// A malicious peer that has the key: changed heads and descriptions with valid hashes and signatures. The memory is bounded by the announced description
    /// (which has a limit), a step, the parts of the description and the text of an error.
    #[test]
    #[allow(clippy::print_stdout)]
    fn lies_under_a_good_signature_are_refused_too() {
        let cases = cases();
        let axis = |name, n| AxisDescription::uniform(name, "m", 0.0, 1.0, n);
        let description = Description::whole(Geometry::Cartesian, vec![axis("x", 5), axis("y", 4)], "s");
        let facts = Facts { kind: Kind::Step, block: 0, generation: 1, step: 2, time: 3.0, published: 4, missed: 0 };
        let limits = Limits { step_bytes: 1 << 16 };
        let mut numbers = Random(1);
        let mut random = |n: usize| numbers.below(n);
        let (mut taken, mut refused) = (0u64, [0u64; 4]);
        let mut max_took = 0;
        for case in 0..cases {
            let [mut from, mut to] = [(); 2].map(|()| Session { key: Key([1; 32]), number: 7, asked: 0 });
            let mut message = Vec::new();
            from.send(&mut message, &facts, Some(&description), &[0.5; 40]).unwrap();
            let begin = HEAD + SIGNATURE;
            for _ in 0..1 + random(3) {
                // The head, or the description.
                let place = if random(2) == 0 { random(HEAD) } else { begin + random(message.len() - begin - 160 - SIGNATURE) };
                match random(3) {
                    0 => message[place] ^= 1 << random(8),
                    1 => message[place] = [0, 1, 2, 0x7f, 0x80, 0xff][random(6)],
                    _ => message[place..place + 4].copy_from_slice(&[0u32, 1, 0x7fff_ffff, u32::MAX][random(4)].to_le_bytes()),
                }
            }
            let signature = from.key.signature(&[&message[..HEAD]]);
            message[HEAD..begin].copy_from_slice(&signature);
            let end = message.len() - SIGNATURE;
            let signature = from.key.signature(&[&message[..HEAD], blake3::hash(&message[begin..end]).as_bytes()]);
            message[end..].copy_from_slice(&signature);
            let mut known = |_, announced: Option<Description>| announced.map(|d| d.block_bytes());
            // The description's length in the head.
            let announced = u32::from_le_bytes(message[64..68].try_into().unwrap());
            let announced = if announced > DESCRIPTION_BYTES { 0 } else { announced as isize };
            let mut values = Vec::new();
            let held = HELD.get();
            PEAK.set(held);
            let received = to.receive(&mut Cursor::new(&message), &limits, &mut known, &mut values);
            let took = PEAK.get() - held;
            max_took = max_took.max(took);
            assert!(took <= announced + (1 << 16) + (1 << 15), "case {case} took {took} bytes, {announced} of them announced");
            match received {
                Ok(facts) => {
                    assert!(facts.time.is_finite() && values.len() <= 1 << 14);
                    taken += 1;
                }
                Err(error) => {
                    let kind = match error {
                        WireError::Field { .. } | WireError::Block { .. } => 0,
                        WireError::TooLarge { .. } => 1,
                        WireError::Short { .. } | WireError::Io { .. } | WireError::Payload => 2,
                        WireError::Replayed { .. } | WireError::Version { .. } => 3,
                        other => panic!("{other}: the signature fits"),
                    };
                    refused[kind] += 1;
                }
            }
        }
        println!("{cases} lies: {taken} taken, {refused:?} refused, {max_took} bytes at most");
        assert!(taken > cases / 20 && refused.iter().all(|n| *n > cases / 1000), "{taken} {refused:?}: the corpus is lopsided");
    }
}
