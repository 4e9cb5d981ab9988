//! Where blocks come from: the ring of this node, or relays of others.

use super::LiveSettings;
use crate::source::SourceError;
use ridgewatch_wire::message::ConnectionFile;
use ridgewatch_wire::relay::{BUFFERS, RelayFollower};
use ridgewatch_wire::{Event, Limits, RING_VARIABLE, RingFollower};
use std::path::PathBuf;
use std::time::Duration;

/// Pause of a thread that finds nothing new.
const IDLE: Duration = Duration::from_millis(1);

/// An open way to the simulation.
pub(super) enum Link {
    Ring(Box<RingFollower>),
    Relays(Vec<RelayFollower>),
}

impl Link {
    /// Opens it, with words on what a simulation must do to be seen.
    pub fn open(settings: &LiveSettings, limits: Limits) -> Result<(Self, String), SourceError> {
        if settings.connections.is_empty() {
            let ring = ring_of(settings)?;
            let follower = RingFollower::begin(&ring, limits).map_err(SourceError::Live)?;
            return Ok((
                Self::Ring(Box::new(follower)),
                format!("waiting for a simulation: start it with {RING_VARIABLE}={}", ring.display()),
            ));
        }
        let mut relays = Vec::new();
        for path in &settings.connections {
            // A file that cannot be believed is refused now; later it is read before each connection.
            ConnectionFile::read(path).map_err(SourceError::Live)?;
            let path = path.clone();
            let gone = Duration::from_secs_f64(settings.relay_timeout_seconds);
            relays.push(RelayFollower::begin(Box::new(move || ConnectionFile::read(&path)), limits, gone).map_err(SourceError::Live)?);
        }
        Ok((Self::Relays(relays), format!("waiting for {} relay(s)", settings.connections.len())))
    }

    /// The next thing that happened, after a short wait for it. A relay one of whose blocks (by index and generation) is ahead of the others' waits until
    /// they have come; the rings of one node see to that themselves.
    pub fn poll(&mut self, values: &mut Vec<f32>, is_ahead: &dyn Fn(u32, u64) -> bool) -> Option<Event> {
        match self {
            Link::Ring(ring) => {
                let event = ring.poll(values);
                if event.is_none() {
                    std::thread::sleep(IDLE);
                }
                event
            }
            Link::Relays(relays) => {
                // The first is waited for, the others just looked at; and each takes its turn as the first.
                relays.rotate_left(1);
                let mut relays = relays.iter_mut().filter(|relay| !relay.blocks().any(|(block, generation)| is_ahead(block, generation)));
                let Some(first) = relays.next() else {
                    std::thread::sleep(IDLE);
                    return None;
                };
                first.poll(values, IDLE).or_else(|| relays.find_map(|relay| relay.poll(values, Duration::ZERO)))
            }
        }
    }

    /// Steps of the global field that are held on the way, at most: a relay's follower has [`BUFFERS`] blocks, and no two relays the same.
    pub fn steps_held(&self) -> u64 {
        match self {
            Link::Ring(_) => 0,
            Link::Relays(_) => BUFFERS,
        }
    }

    /// Says that somebody is there, where that was not said for a second: between the pieces of what takes long. A relay hears it from a thread of its own.
    pub fn beat(&mut self) {
        if let Link::Ring(ring) = self {
            ring.beat();
        }
    }

    /// Says that somebody is there, without taking anything.
    pub fn hold(&mut self) {
        if let Link::Ring(ring) = self {
            ring.hold();
        }
    }
}

/// The ring's folder.
pub fn ring_of(settings: &LiveSettings) -> Result<PathBuf, SourceError> {
    let named = ridgewatch_wire::ring_from_environment;
    settings.ring.clone().or_else(named).ok_or_else(|| SourceError::Setting {
        key: "live.ring",
        found: "missing".into(),
        accepted: format!("a folder (it is made), or the environment variable {RING_VARIABLE}, or live.connections"),
    })
}
