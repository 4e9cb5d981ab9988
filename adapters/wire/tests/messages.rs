//! Messages over real sockets: keys, changes on the way, replays, wrong lengths.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "support/sessions.rs"]
mod sessions;

use ridgewatch_wire::message::{ASK_BYTES, Ask, ConnectionFile, Facts, Key, Kind, Session};
use ridgewatch_wire::{AxisDescription, Description, Geometry, Limits, WireError};
use sessions::{session, sessions};
use std::io::{Cursor, Read, Write};
use std::net::{TcpListener, TcpStream};

fn description() -> Description {
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 4);
    Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s")
}

fn facts(step: u64) -> Facts {
    Facts { kind: Kind::Step, block: 0, generation: 5, step, time: step as f64, published: 1, missed: 0 }
}

/// Two complete messages of a session, as bytes.
fn two(session: &mut Session) -> (Vec<u8>, Vec<u8>) {
    let values: Vec<f32> = (0..32).map(|v| v as f32).collect();
    let (mut first, mut second) = (Vec::new(), Vec::new());
    session.send(&mut first, &facts(1), Some(&description()), &values).unwrap();
    let values: Vec<f32> = values.iter().map(|v| -v).collect();
    session.send(&mut second, &facts(2), Some(&description()), &values).unwrap();
    (first, second)
}

fn receive(session: &mut Session, bytes: &[u8], known: &mut Option<Description>) -> Result<(Facts, Vec<f32>), WireError> {
    let mut values = Vec::new();
    let mut note = |_, announced: Option<Description>| {
        if announced.is_some() {
            *known = announced;
        }
        known.as_ref().map(Description::block_bytes)
    };
    let facts = session.receive(&mut Cursor::new(bytes), &Limits::default(), &mut note, &mut values)?;
    Ok((facts, values))
}

#[test]
fn messages_arrive_once_and_in_order() {
    let (mut server, mut client) = session();
    let (first, second) = two(&mut server);
    let mut known = None;
    let (facts_1, values) = receive(&mut client, &first, &mut known).unwrap();
    assert_eq!((facts_1, values[31], known.clone()), (facts(1), 31.0, Some(description())));
    assert_eq!(receive(&mut client, &second, &mut known).unwrap().0, facts(2));
    for replay in [&first, &second] {
        assert!(matches!(receive(&mut client, replay, &mut known), Err(WireError::Replayed { newest: 2, .. })));
    }
    // In another session.
    assert!(matches!(receive(&mut session().1, &first, &mut None), Err(WireError::Signature)));
}

#[test]
fn wrong_keys_are_refused_by_either_side() {
    let (server, client) = sessions(&Key::random().unwrap(), &Key::random().unwrap());
    assert!(matches!(server, Err(WireError::Signature)));
    assert!(matches!(client, Err(WireError::Rejected)));
    // A relay without the key cannot prove it, whatever it answers.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let client = std::thread::spawn(move || Session::connect(&mut TcpStream::connect(address).unwrap(), &Key::random().unwrap()));
    let (mut stream, _) = listener.accept().unwrap();
    stream.write_all(b"RIDGEWIRE\0\0\0\x04\0\0\0").unwrap();
    stream.write_all(&[7; 32]).unwrap();
    let mut greeting = [0; 80];
    stream.read_exact(&mut greeting).unwrap();
    stream.write_all(&greeting[48..]).unwrap();
    assert!(matches!(client.join().unwrap(), Err(WireError::Signature)), "its own proof, sent back");
}

#[test]
fn every_changed_byte_is_noticed() {
    let (mut server, mut client) = session();
    let (first, _) = two(&mut server);
    for place in 0..first.len() {
        let mut changed = first.clone();
        changed[place] ^= 1 << (place % 8);
        let error = receive(&mut client, &changed, &mut None).map(|_| ()).unwrap_err();
        match place {
            0..108 => assert!(matches!(error, WireError::Signature), "{place}: {error}"),
            // A message with a valid head uses up its number.
            _ => {
                let (mut server, mut client) = session();
                let (mut message, _) = two(&mut server);
                message[place] ^= 1 << (place % 8);
                let error = receive(&mut client, &message, &mut None).map(|_| ()).unwrap_err();
                assert!(!matches!(error, WireError::Signature | WireError::Replayed { .. }), "{place}: {error}");
                // Values and the last signature; the description is checked before them.
                assert!(place < first.len() - 160 || matches!(error, WireError::Payload), "{place}: {error}");
            }
        }
    }
    let (first, _) = two(&mut server);
    for length in [0, 1, 50, 107, 108, 200, first.len() - 1] {
        assert!(receive(&mut client, &first[..length], &mut None).is_err(), "{length}");
    }
}

#[test]
fn a_head_vouches_for_no_other_payload() {
    let (mut server, mut client) = session();
    let (first, second) = two(&mut server);
    assert_eq!(first.len(), second.len());
    let spliced = [&first[..108], &second[108..]].concat();
    assert!(matches!(receive(&mut client, &spliced, &mut None), Err(WireError::Payload)));
}

#[test]
fn what_a_follower_asks_is_believed_once_and_unchanged() {
    let (mut server, mut client) = session();
    let mut ask = |ask| -> [u8; ASK_BYTES] {
        let mut bytes = Vec::new();
        client.ask(&mut bytes, ask).unwrap();
        bytes.try_into().unwrap()
    };
    let (first, second) = (ask(Ask::Next), ask(Ask::Hold));
    for place in 0..ASK_BYTES {
        let mut changed = first;
        changed[place] ^= 1 << (place % 8);
        assert!(matches!(server.check_ask(&changed), Err(WireError::Signature)), "{place}");
    }
    assert_eq!((server.check_ask(&first).unwrap(), server.check_ask(&second).unwrap()), (Ask::Next, Ask::Hold));
    for replay in [&first, &second] {
        assert!(matches!(server.check_ask(replay), Err(WireError::Replayed { newest: 2, .. })));
    }
    // In another session.
    assert!(matches!(session().0.check_ask(&first), Err(WireError::Signature)));
}

#[test]
fn connection_files_are_private_and_checked() {
    use std::os::unix::fs::PermissionsExt;
    let folder = std::env::temp_dir().join(format!("rw-connection-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("connection");
    let file = ConnectionFile { address: "127.0.0.1:4711".into(), key: Key::random().unwrap() };
    file.write(&path).unwrap();
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(ConnectionFile::read(&path).unwrap(), file);
    // Another relay's file is not removed.
    ConnectionFile { key: Key::random().unwrap(), ..file.clone() }.remove(&path);
    assert_eq!(ConnectionFile::read(&path).unwrap(), file);
    file.remove(&path);
    assert!(!path.exists());
    file.write(&path).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    for (changed, expected) in [
        (text.replace("connection = 1", "connection = 2"), "the connection file has version 2; only version 1 is supported"),
        (text.replace("key = ", "key = zz"), "66 characters"),
        (text.replace("address", "adress"), "`address` is missing"),
        (String::new(), "`ridgewatch-connection` is missing"),
    ] {
        std::fs::write(&path, changed).unwrap();
        let error = ConnectionFile::read(&path).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o644)).unwrap();
    assert!(matches!(ConnectionFile::read(&path), Err(WireError::Foreign { found, .. }) if found == "has mode 0644"));
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
#[ignore = "gives a file to another user, which needs root"]
fn a_connection_file_of_another_user_is_refused() {
    let path = std::env::temp_dir().join(format!("rw-connection-theirs-{}", std::process::id()));
    ConnectionFile { address: "127.0.0.1:4711".into(), key: Key::random().unwrap() }.write(&path).unwrap();
    std::os::unix::fs::chown(&path, Some(12345), None).unwrap();
    let read = ConnectionFile::read(&path);
    std::fs::remove_file(&path).unwrap();
    assert!(matches!(read, Err(WireError::Foreign { found, .. }) if found == "belongs to user 12345"));
}
