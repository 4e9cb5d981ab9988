//! A flood of subscriptions: the healthy subscriber's frames go on, and nothing is left behind.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod kit;

use kit::Flood;
use ridgewatch_zmtp::{Keep, Limits, Peers, PubSocket};
use std::time::Duration;

#[test]
#[ignore = "is the other process of the tests beside it"]
fn attacker() {
    kit::attack_if_asked();
}

#[test]
fn a_flood_costs_others_nothing() {
    let socket = PubSocket::bind("tcp://127.0.0.1:0", Some(Peers::Any), Limits::default()).unwrap();
    let address = socket.endpoint().strip_prefix("tcp://").unwrap().parse().unwrap();
    let of = Flood { connections: 240, users: &[kit::user()], duration: Duration::from_secs(5) };
    let outcome = kit::flood(address, of, &mut || {
        if socket.has_room(b"frame", Keep::Newest, Duration::ZERO) {
            socket.send(&[b"frame", b"{}"], vec![7; 512 << 10], Keep::Newest);
        }
        socket.send(&[b"record"], b"{}".to_vec(), Keep::All);
    });
    println!("{:?}", socket.counts());
    kit::check(&outcome);
    assert!(socket.counts().faults > 240, "{:?}", socket.counts());
}
