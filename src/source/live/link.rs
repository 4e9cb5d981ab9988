//! Origin of the blocks: the ring of this node, or relays of other nodes.

use super::settings::LiveSettings;
use crate::error::SourceError;
use ridgewatch_wire::message::ConnectionFile;
use ridgewatch_wire::relay::{BUFFERS, RelayFollower};
use ridgewatch_wire::{Event, Limits, RING_VARIABLE, RingFollower};
use std::path::PathBuf;
use std::time::Duration;

/// Pause of the thread if nothing is new.
const IDLE: Duration = Duration::from_millis(1);

/// An open connection to the simulation.
pub(super) enum Link {
    Ring(Box<RingFollower>),
    Relays(Vec<RelayFollower>),
}

impl Link {
    /// Opens the connection. Returns also instructions for starting the simulation.
    ///
    /// # Errors
    /// A ring or connection file that cannot be used, or none at all.
    pub fn open(settings: &LiveSettings, limits: Limits) -> Result<(Self, String), SourceError> {
        if settings.connections.is_empty() {
            let ring = ring_of(settings)?;
            let follower = RingFollower::begin(&ring, limits).map_err(SourceError::Live)?;
            let how = format!("waiting for a simulation: start it with {RING_VARIABLE}={}", ring.display());
            return Ok((Self::Ring(Box::new(follower)), how));
        }
        let mut relays = Vec::new();
        for path in &settings.connections {
            // An invalid file is refused now; later it is read before each connection.
            ConnectionFile::read(path).map_err(SourceError::Live)?;
            let path = path.clone();
            let gone = Duration::from_secs_f64(settings.relay_timeout_seconds);
            relays.push(RelayFollower::begin(Box::new(move || ConnectionFile::read(&path)), limits, gone).map_err(SourceError::Live)?);
        }
        Ok((Self::Relays(relays), format!("waiting for {} relay(s)", settings.connections.len())))
    }

    /// The next event, after a short wait for it. A relay waits while one of its blocks (by index and generation) is ahead of the
    /// blocks of other relays. The rings of one node ensure this themselves.
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
                // Wait for the first relay only and poll the others; each takes its turn as the first.
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

    /// Largest number of steps of the global field that are buffered: a relay's follower has [`BUFFERS`] blocks, and no two relays have
    /// the same block.
    pub fn steps_held(&self) -> u64 {
        match self {
            Link::Ring(_) => 0,
            Link::Relays(_) => BUFFERS,
        }
    }

    /// Renews the heartbeat if it is older than a second; to be called during long work. A relay has a thread for its heartbeat.
    pub fn beat(&mut self) {
        if let Link::Ring(ring) = self {
            ring.beat();
        }
    }

    /// Renews the heartbeat without taking a step.
    pub fn hold(&mut self) {
        if let Link::Ring(ring) = self {
            ring.hold();
        }
    }
}

/// The ring's folder.
///
/// # Errors
/// Neither the settings nor the environment name one.
pub fn ring_of(settings: &LiveSettings) -> Result<PathBuf, SourceError> {
    let named = ridgewatch_wire::ring_from_environment;
    settings.ring.clone().or_else(named).ok_or_else(|| {
        let accepted = format!("a folder (it is made), or the environment variable {RING_VARIABLE}, or live.connections");
        SourceError::setting("live.ring", "missing", accepted)
    })
}
