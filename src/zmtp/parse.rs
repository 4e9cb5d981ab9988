//! What a peer sends (rfc.zeromq.org/spec/23 and 37): greeting, READY, PING, and subscriptions or the parts of messages.

use thiserror::Error;

/// Length of a greeting, in bytes.
pub(crate) const GREETING: usize = 64;
/// Maximum length of a frame from a peer. A frame holds a topic, a few properties or a command.
const MAX_FRAME_BYTES: usize = 4096;
/// Longest header of a frame, in bytes.
const HEADER: usize = 9;
/// Maximum length of the context of a PING, in bytes.
const MAX_CONTEXT: usize = 16;
/// Bits of a frame's first byte.
pub(crate) const MORE: u8 = 1;
pub(crate) const LONG: u8 = 2;
pub(crate) const COMMAND: u8 = 4;

/// Why a peer is disconnected for what it sent.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Fault {
    /// No greeting of ZMTP 3.
    #[error("not a greeting of ZMTP 3")]
    Greeting,
    /// A mechanism other than NULL.
    #[error("the mechanism is not NULL")]
    Mechanism,
    /// A frame whose flags no version of ZMTP 3 has.
    #[error("a frame with the flags {0:#04x}")]
    Flags(u8),
    /// A frame longer than any subscription.
    #[error("a frame of {0} bytes; accepted are {MAX_FRAME_BYTES}")]
    Length(u64),
    /// A command that is cut short or has no name.
    #[error("a command that cannot be read")]
    Command,
    /// Something else where READY is due.
    #[error("no READY after the greeting")]
    Ready,
    /// A socket that is not SUB or XSUB, or not DEALER or REQ.
    #[error("its socket is of a type that is not served")]
    SocketType,
    /// A message of too many parts.
    #[error("a message of more parts than are accepted")]
    Parts,
    /// The peer reports an error of its own.
    #[error("the peer sent ERROR")]
    Error,
    /// More or longer subscriptions than [`crate::Limits`] accepts.
    #[error("more subscriptions than are accepted")]
    Subscriptions,
    /// Frames at a higher rate than [`crate::Limits`] accepts.
    #[error("more frames a second than are accepted")]
    Rate,
}

/// Meaning of the next bytes from a peer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Incoming {
    /// The greeting.
    Greeting,
    /// READY of a subscriber.
    Ready,
    /// A topic, as a prefix.
    Subscribe(Vec<u8>),
    /// A topic that ends.
    Cancel(Vec<u8>),
    /// A part of a message to a ROUTER.
    Part {
        /// Its bytes.
        body: Vec<u8>,
        /// Whether another part follows.
        more: bool,
    },
    /// A PING; PONG returns its context.
    Ping(Vec<u8>),
    /// Anything else, which is ignored.
    Other,
}

/// The socket that is served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// PUB, to SUB and XSUB.
    Pub,
    /// ROUTER, to DEALER and REQ.
    Router,
}

impl Role {
    fn accepts(self, socket_type: &[u8]) -> bool {
        match self {
            Self::Pub => matches!(socket_type, b"SUB" | b"XSUB"),
            Self::Router => matches!(socket_type, b"DEALER" | b"REQ"),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Greeting,
    Ready,
    Open,
}

/// Reads the bytes of one peer, in a buffer of fixed size.
#[derive(Debug)]
pub struct Parser {
    role: Role,
    stage: Stage,
    buffer: Box<[u8]>,
    start: usize,
    end: usize,
    /// Whether the last frame of a message announced another one.
    within: bool,
}

impl Default for Parser {
    fn default() -> Self {
        Self::of(Role::Pub)
    }
}

impl Parser {
    /// A parser of what peers send to this socket.
    pub fn of(role: Role) -> Self {
        Self { role, stage: Stage::Greeting, buffer: vec![0; HEADER + MAX_FRAME_BYTES].into(), start: 0, end: 0, within: false }
    }

    /// Where to put the next bytes. Never empty once [`Parser::parse`] has returned `None`.
    pub fn space(&mut self) -> &mut [u8] {
        self.buffer.copy_within(self.start..self.end, 0);
        (self.start, self.end) = (0, self.end - self.start);
        &mut self.buffer[self.end..]
    }

    /// So many bytes were put into [`Parser::space`].
    pub fn filled(&mut self, count: usize) {
        self.end = self.buffer.len().min(self.end + count);
    }

    /// The next complete unit. `None`: more bytes are needed.
    ///
    /// # Errors
    /// Bytes that no peer of this socket sends. The peer is not to be read any further.
    pub fn parse(&mut self) -> Result<Option<Incoming>, Fault> {
        if self.stage == Stage::Greeting { self.greeting() } else { self.frame() }
    }

    fn greeting(&mut self) -> Result<Option<Incoming>, Fault> {
        let bytes = &self.buffer[self.start..self.end];
        // As early as possible, so that a stranger of another protocol is not waited for.
        if bytes.first().is_some_and(|byte| *byte != 0xff)
            || bytes.get(9).is_some_and(|byte| *byte != 0x7f)
            || bytes.get(10).is_some_and(|major| *major < 3)
        {
            return Err(Fault::Greeting);
        }
        let Some(greeting) = bytes.get(..GREETING) else { return Ok(None) };
        if &greeting[12..32] != b"NULL\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0" {
            return Err(Fault::Mechanism);
        }
        self.start += GREETING;
        self.stage = Stage::Ready;
        Ok(Some(Incoming::Greeting))
    }

    fn frame(&mut self) -> Result<Option<Incoming>, Fault> {
        let bytes = &self.buffer[self.start..self.end];
        let Some((&flags, rest)) = bytes.split_first() else { return Ok(None) };
        if flags & !(MORE | LONG | COMMAND) != 0 || flags & (COMMAND | MORE) == COMMAND | MORE {
            return Err(Fault::Flags(flags));
        }
        let header = if flags & LONG == 0 { 2 } else { HEADER };
        let length = match rest.get(..header - 1) {
            Some(length) => length.iter().fold(0, |sum, byte| sum << 8 | u64::from(*byte)),
            None => return Ok(None),
        };
        if length > MAX_FRAME_BYTES as u64 {
            return Err(Fault::Length(length));
        }
        let Some(body) = bytes.get(header..header + length as usize) else { return Ok(None) };
        let first = !std::mem::replace(&mut self.within, flags & MORE != 0);
        let incoming = match self.stage {
            Stage::Open if flags & COMMAND != 0 => command(body)?,
            Stage::Open if self.role == Role::Router => Incoming::Part { body: body.to_vec(), more: flags & MORE != 0 },
            Stage::Open if flags & MORE == 0 && first => message(body),
            Stage::Open => Incoming::Other,
            _ if flags & COMMAND != 0 => ready(body, self.role)?,
            _ => return Err(Fault::Ready),
        };
        self.stage = Stage::Open;
        self.start += header + length as usize;
        Ok(Some(incoming))
    }
}

/// A subscription of ZMTP 3.0, which is a message.
fn message(body: &[u8]) -> Incoming {
    match body.split_first() {
        Some((1, topic)) => Incoming::Subscribe(topic.to_vec()),
        Some((0, topic)) => Incoming::Cancel(topic.to_vec()),
        _ => Incoming::Other,
    }
}

/// Splits bytes that begin with their length.
fn short(bytes: &[u8]) -> Result<(&[u8], &[u8]), Fault> {
    let (length, rest) = bytes.split_first().ok_or(Fault::Command)?;
    rest.split_at_checked(usize::from(*length)).ok_or(Fault::Command)
}

fn command(body: &[u8]) -> Result<Incoming, Fault> {
    let (name, rest) = short(body)?;
    Ok(match name {
        b"SUBSCRIBE" => Incoming::Subscribe(rest.to_vec()),
        b"CANCEL" => Incoming::Cancel(rest.to_vec()),
        // Its first two bytes are a time to live, which TCP and the deadline of a write make needless.
        b"PING" => Incoming::Ping(rest.get(2..).filter(|context| context.len() <= MAX_CONTEXT).ok_or(Fault::Command)?.to_vec()),
        b"ERROR" => return Err(Fault::Error),
        _ => Incoming::Other,
    })
}

fn ready(body: &[u8], role: Role) -> Result<Incoming, Fault> {
    let (name, mut properties) = short(body)?;
    match name {
        b"READY" => {}
        b"ERROR" => return Err(Fault::Error),
        _ => return Err(Fault::Ready),
    }
    let mut is_served = false;
    while !properties.is_empty() {
        let (key, rest) = short(properties)?;
        let (length, rest) = rest.split_first_chunk::<4>().ok_or(Fault::Command)?;
        let (value, rest) = rest.split_at_checked(u32::from_be_bytes(*length) as usize).ok_or(Fault::Command)?;
        if key.eq_ignore_ascii_case(b"Socket-Type") {
            is_served = role.accepts(value);
        }
        properties = rest;
    }
    if is_served { Ok(Incoming::Ready) } else { Err(Fault::SocketType) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const READY: &[u8] = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB";

    fn greeting() -> Vec<u8> {
        let mut bytes = vec![0; GREETING];
        (bytes[0], bytes[9], bytes[10]) = (0xff, 0x7f, 3);
        bytes[12..16].copy_from_slice(b"NULL");
        bytes
    }

    /// A frame that announces `length` bytes.
    fn frame(flags: u8, length: u64, body: &[u8]) -> Vec<u8> {
        let length = if flags & LONG != 0 { length.to_be_bytes().to_vec() } else { vec![length as u8] };
        [&[flags], length.as_slice(), body].concat()
    }

    /// What bytes mean that arrive in pieces of these lengths, in turn.
    fn parsed(bytes: &[u8], pieces: &[usize]) -> Result<Vec<Incoming>, Fault> {
        parsed_by(Parser::default(), bytes, pieces)
    }

    fn parsed_by(mut parser: Parser, bytes: &[u8], pieces: &[usize]) -> Result<Vec<Incoming>, Fault> {
        let (mut rest, mut found) = (bytes, Vec::new());
        for piece in pieces.iter().cycle() {
            while let Some(incoming) = parser.parse()? {
                found.push(incoming);
            }
            if rest.is_empty() {
                break;
            }
            let space = parser.space();
            let count = rest.len().min(space.len()).min(*piece);
            assert!(count > 0, "there is always space");
            space[..count].copy_from_slice(&rest[..count]);
            parser.filled(count);
            rest = &rest[count..];
        }
        Ok(found)
    }

    fn talk() -> Vec<u8> {
        [
            greeting(),
            READY.to_vec(),
            frame(0, 6, b"\x01frame"),
            frame(LONG, 7, b"\x01record"),
            frame(COMMAND, 15, b"\x09SUBSCRIBEframe"),
            frame(COMMAND | LONG, 12, b"\x06CANCELframe"),
            frame(COMMAND, 11, b"\x04PING\x00\x00abcd"),
            frame(0, 7, b"\x00record"),
            frame(MORE, 2, b"\x01a"),
            frame(0, 2, b"\x01b"),
            frame(0, 0, b""),
            frame(COMMAND, 4, b"\x03NEW"),
        ]
        .concat()
    }

    #[test]
    fn both_forms_of_subscriptions_are_read() {
        let (on, off) = (|topic: &str| Incoming::Subscribe(topic.into()), |topic: &str| Incoming::Cancel(topic.into()));
        let expected = vec![
            Incoming::Greeting,
            Incoming::Ready,
            on("frame"),
            on("record"),
            on("frame"),
            off("frame"),
            Incoming::Ping(b"abcd".to_vec()),
            off("record"),
            Incoming::Other,
            Incoming::Other,
            Incoming::Other,
            Incoming::Other,
        ];
        assert_eq!(parsed(&talk(), &[usize::MAX]).unwrap(), expected);
        assert_eq!(parsed(&talk(), &[1]).unwrap(), expected);
    }

    #[test]
    fn what_no_subscriber_sends_is_refused() {
        let open = [greeting(), READY.to_vec()].concat();
        for (bytes, fault) in [
            (frame(LONG, 1 << 50, b""), Fault::Length(1 << 50)),
            (frame(LONG | COMMAND, u64::MAX, b""), Fault::Length(u64::MAX)),
            (frame(LONG, 4097, &[0; 100]), Fault::Length(4097)),
            (frame(8, 1, b"a"), Fault::Flags(8)),
            (frame(COMMAND | MORE, 1, b"a"), Fault::Flags(5)),
            (frame(COMMAND, 0, b""), Fault::Command),
            (frame(COMMAND, 3, b"\x05PI"), Fault::Command),
            (frame(COMMAND, 24, b"\x04PING\x00\x0001234567890123456"), Fault::Command),
            (frame(COMMAND, 7, b"\x05ERROR\x00"), Fault::Error),
        ] {
            assert_eq!(parsed(&[open.clone(), bytes].concat(), &[usize::MAX]), Err(fault));
        }
        for (bytes, fault) in [
            (frame(0, 6, b"\x01frame"), Fault::Ready),
            (frame(COMMAND, 6, b"\x05READY"), Fault::SocketType),
            (frame(COMMAND, 25, b"\x05READY\x0bSocket-Type\x00\x00\x00\x03PUB"), Fault::SocketType),
            (frame(COMMAND, 25, b"\x05READY\x0bSocket-Type\x00\x00\x00\x04SUB"), Fault::Command),
            (frame(COMMAND, 6, b"\x05HELLO"), Fault::Ready),
            (frame(LONG, 1 << 50, b""), Fault::Length(1 << 50)),
        ] {
            assert_eq!(parsed(&[greeting(), bytes].concat(), &[usize::MAX]), Err(fault));
        }
        assert_eq!(parsed(b"GET / HTTP/1.1\r\n", &[1]), Err(Fault::Greeting));
        assert_eq!(parsed(&[0xff, 0, 0, 0, 0, 0, 0, 0, 1, 0x7f, 2], &[1]), Err(Fault::Greeting), "ZMTP 2");
        let mut curve = greeting();
        curve[12..17].copy_from_slice(b"CURVE");
        assert_eq!(parsed(&curve, &[usize::MAX]), Err(Fault::Mechanism));
    }

    #[test]
    fn a_router_gets_the_parts_of_messages_and_other_peers() {
        let ready = |kind: &[u8]| {
            let body = [&b"\x05READY\x0bSocket-Type\0\0\0"[..], &[kind.len() as u8], kind].concat();
            [greeting(), frame(COMMAND, body.len() as u64, &body)].concat()
        };
        let router = |bytes: &[u8]| parsed_by(Parser::of(Role::Router), bytes, &[3]);
        for kind in [&b"DEALER"[..], b"REQ"] {
            let bytes = [ready(kind), frame(MORE, 0, b""), frame(0, 2, b"\x01a"), frame(COMMAND, 8, b"\x04PING\0\0a")].concat();
            let part = |body: &[u8], more| Incoming::Part { body: body.to_vec(), more };
            let expected = [Incoming::Greeting, Incoming::Ready, part(b"", true), part(b"\x01a", false), Incoming::Ping(b"a".to_vec())];
            assert_eq!(router(&bytes).unwrap(), expected);
            assert_eq!(parsed(&bytes, &[3]), Err(Fault::SocketType));
            assert_eq!(router(&[ready(kind), frame(LONG, 4097, b"")].concat()), Err(Fault::Length(4097)));
        }
        assert_eq!(router(&ready(b"SUB")), Err(Fault::SocketType));
    }

    proptest! {
        /// Changed, removed and added bytes end in a fault or in units, never in a panic, and not differently in other pieces.
        #[test]
        fn mutants_are_read_alike_in_any_pieces(
            changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..3), 0..8),
            pieces in prop::collection::vec(1usize..200, 1..10),
        ) {
            let mut bytes = talk();
            for (place, byte, kind) in changes {
                let place = place.index(bytes.len());
                match kind {
                    0 => bytes[place] = byte,
                    1 => drop(bytes.remove(place)),
                    _ => bytes.insert(place, byte),
                }
            }
            prop_assert_eq!(parsed(&bytes, &pieces), parsed(&bytes, &[usize::MAX]));
            // To a router, whose peer says REQ.
            bytes.splice(0..bytes.len().min(GREETING + READY.len()), [greeting(), [&READY[..READY.len() - 3], b"REQ"].concat()].concat());
            let routed = |pieces: &[usize]| parsed_by(Parser::of(Role::Router), &bytes, pieces);
            prop_assert_eq!(routed(&pieces), routed(&[usize::MAX]));
        }

        #[test]
        fn any_bytes_after_a_handshake_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..6000)) {
            let _ = parsed(&bytes, &[usize::MAX]);
            let _ = parsed(&[greeting(), bytes.clone()].concat(), &[100]);
            let _ = parsed(&[greeting(), READY.to_vec(), bytes].concat(), &[usize::MAX]);
        }
    }
}
