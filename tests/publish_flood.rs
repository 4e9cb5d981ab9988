//! Floods of subscriptions from many connections: the healthy subscriber goes on, and nothing is left behind.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod kit;

use kit::publishing::{frame, zmtp};
use ridgewatch::publish::{Payload, Peers, PublishSettings, Publisher};
use ridgewatch::render::Film;
use ridgewatch::run::FrameRecord;
use std::sync::Arc;
use std::time::Duration;

/// Another user than any that runs tests.
const NOBODY: u32 = 65534;

#[test]
#[ignore = "is the other process of the tests beside it"]
fn attacker() {
    zmtp::attack_if_asked();
}

/// Frames of 512 KiB, ten a second.
fn flood(connections: usize, users: &[u32], duration: Duration) {
    let settings = PublishSettings { payload: Payload::Raw, peers: Some(Peers::Any), ..Default::default() };
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings).unwrap();
    let address = publisher.endpoint().strip_prefix("tcp://").unwrap().parse().unwrap();
    let film = Arc::new(Film { width: 256, height: 128, rgba: vec![[0.25, 0.5, 0.75, 1.0]; 256 * 128], ..Default::default() });
    let mut number = 0;
    let outcome = zmtp::flood(address, zmtp::Flood { connections, users, duration }, &mut || {
        publisher.frame(frame(FrameRecord { frame: number, ..Default::default() }, film.clone()));
        number += 1;
    });
    println!("{connections} connections of each of {users:?} for {duration:?}: {:?}", publisher.statistics());
    zmtp::check(&outcome);
    let open = zmtp::open_descriptors();
    drop(publisher);
    std::thread::sleep(Duration::from_millis(500));
    assert!(zmtp::open_descriptors() < open, "the socket is closed");
}

#[test]
fn a_flood_of_subscriptions_silences_nobody() {
    // As another user if this one may.
    let user = if zmtp::user() == 0 { NOBODY } else { zmtp::user() };
    flood(240, &[user], Duration::from_secs(8));
}

#[test]
#[ignore = "takes twice FLOOD_SECONDS (600)"]
fn long_floods_silence_nobody() {
    let seconds = std::env::var("FLOOD_SECONDS").map_or(600, |text| text.parse().unwrap());
    let users: &[u32] = if zmtp::user() == 0 { &[0, NOBODY] } else { &[zmtp::user()] };
    for connections in [240, 1000] {
        flood(connections, users, Duration::from_secs(seconds));
    }
}
