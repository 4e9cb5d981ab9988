//! Floods of subscriptions: the healthy subscriber's frames go on, and nothing is left behind.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod kit;

use kit::{Flood, Outcome, flood};
use ridgewatch_zmtp::{Keep, Limits, Peers, PubSocket};
use std::time::Duration;

#[test]
#[ignore = "is the other process of the tests beside it"]
fn attacker() {
    kit::attack_if_asked();
}

fn flooded(of: Flood) -> Outcome {
    let socket = PubSocket::bind("tcp://127.0.0.1:0", Some(Peers::Any), Limits::default()).unwrap();
    let address = socket.endpoint().strip_prefix("tcp://").unwrap().parse().unwrap();
    let outcome = flood(address, of, &mut || {
        if socket.has_room(Duration::ZERO) {
            socket.send(&[b"frame", b"{}"], vec![7; 512 << 10], Keep::Newest);
        }
        socket.send(&[b"record"], b"{}".to_vec(), Keep::All);
    });
    println!("largest gap {:?}, {} frames, {outcome:?}\n{:?}", outcome.gap, outcome.frames, socket.counts());
    outcome
}

fn check(outcome: &Outcome) {
    assert!(outcome.gap < Duration::from_secs(3), "{outcome:?}");
    let [before, _, after] = outcome.descriptors;
    assert!(after <= before, "{outcome:?}");
    let [before, most, _] = outcome.resident;
    assert!(most <= before + 32, "{outcome:?}");
}

#[test]
fn a_flood_of_this_user_costs_others_nothing() {
    check(&flooded(Flood { connections: 240, users: &[kit::user()], duration: Duration::from_secs(5) }));
}

/// Another user, if this one may become it.
#[test]
#[ignore = "takes `SECONDS` (600) for 240 and for 1000 connections of two users, and needs root"]
fn a_long_flood_of_two_users() {
    let seconds = std::env::var("SECONDS").map_or(600, |text| text.parse().unwrap());
    for connections in [240, 1000] {
        println!("{connections} connections of each user");
        check(&flooded(Flood { connections, users: &[kit::user(), 65534], duration: Duration::from_secs(seconds) }));
    }
}
