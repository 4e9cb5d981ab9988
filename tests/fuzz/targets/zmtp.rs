//! Handshakes, subscriptions and messages of any bytes, read as a publisher, a router and a subscriber read them: no panic, no memory for what is only
//! announced, and no other meaning if the bytes arrive in other pieces.
#![no_main]

use libfuzzer_sys::fuzz_target;
use ridgewatch_zmtp::{Fault, Incoming, Parser, Role, Subscriber};
use std::io::Cursor;
use tokio::io::{join, sink};

/// Length of the longest message that the subscriber accepts, in bytes.
const MESSAGE_BYTES: usize = 1 << 12;
/// Most topics and commands that are compared.
const MOST_UNITS: usize = 1 << 12;

/// A greeting and READY of a socket of this type.
fn handshake(socket: &[u8; 3]) -> Vec<u8> {
    let mut bytes = vec![0; 64];
    (bytes[0], bytes[9], bytes[10]) = (0xff, 0x7f, 3);
    bytes[12..16].copy_from_slice(b"NULL");
    bytes.extend(b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03");
    bytes.extend(socket);
    bytes
}

/// What the bytes mean to a socket, if they arrive in pieces of one length.
fn parsed(role: Role, bytes: &[u8], piece: usize) -> (Vec<Incoming>, Option<Fault>) {
    let (mut parser, mut rest, mut found) = (Parser::of(role), bytes, Vec::new());
    loop {
        match parser.parse() {
            Ok(Some(unit)) => found.push(unit),
            Err(fault) => return (found, Some(fault)),
            Ok(None) if rest.is_empty() || found.len() > MOST_UNITS => return (found, None),
            Ok(None) => {
                let space = parser.space();
                let count = rest.len().min(space.len()).min(piece);
                assert!(count > 0, "there is always space");
                space[..count].copy_from_slice(&rest[..count]);
                parser.filled(count);
                rest = &rest[count..];
            }
        }
    }
}

/// Reads all messages that the bytes of a publisher hold.
async fn received(bytes: Vec<u8>) {
    let stream = Box::new(join(Cursor::new(bytes), sink()));
    let Ok(mut subscriber) = Subscriber::over(stream, &["frame"], MESSAGE_BYTES).await else { return };
    while let Ok(parts) = subscriber.receive().await {
        assert!(parts.iter().map(|part| part.len()).sum::<usize>() <= MESSAGE_BYTES);
    }
}

fuzz_target!(|input: &[u8]| {
    let Some((&kind, bytes)) = input.split_first() else { return };
    let after = |socket| if kind & 1 == 1 { [handshake(socket), bytes.to_vec()].concat() } else { bytes.to_vec() };
    let piece = 1 + usize::from(kind >> 1);
    for (role, peer) in [(Role::Pub, after(b"SUB")), (Role::Router, after(b"REQ"))] {
        assert_eq!(parsed(role, &peer, piece), parsed(role, &peer, usize::MAX));
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    runtime.block_on(received(after(b"PUB")));
});
