//! `[live]` of a scene file.

use ridgewatch_base::setting::{Refused, require};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Handling of steps that arrive while a frame is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Follow {
    /// The window continues to fill; the next frame uses the newest steps.
    #[default]
    Newest,
    /// No step is taken before its slide is due: a producer with the waiting policy slows down to the pace of the frames.
    Every,
}

/// Action at the end of the simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AtEnd {
    /// Wait for a restart.
    #[default]
    Wait,
    /// End the run.
    Stop,
}

/// `[live]`: a running simulation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LiveSettings {
    /// Folder of the ring on this node; by default that of the environment variable `RIDGEWATCH_RING`, or a relay.
    pub ring: Option<PathBuf>,
    /// Connection files of relays on other nodes, instead of a ring.
    pub connections: Vec<PathBuf>,
    /// GiB of memory for the window, the window of the current frame, and the data on the way: steps that wait for blocks, and buffers.
    pub memory_gib: f64,
    /// Newest steps or every step.
    pub follow: Follow,
    /// Action at the end of the simulation.
    pub at_end: AtEnd,
    /// Seconds that a step waits for its missing blocks.
    pub block_timeout_seconds: f64,
    /// Seconds that a relay may be unreachable before its blocks count as ended.
    pub relay_timeout_seconds: f64,
}

impl Default for LiveSettings {
    fn default() -> Self {
        Self {
            ring: None,
            connections: Vec::new(),
            memory_gib: 4.0,
            follow: Follow::default(),
            at_end: AtEnd::default(),
            block_timeout_seconds: 10.0,
            relay_timeout_seconds: 30.0,
        }
    }
}

impl LiveSettings {
    /// Bytes of memory.
    pub(super) fn memory_bytes(&self) -> u64 {
        (self.memory_gib * f64::from(1 << 30)) as u64
    }

    /// Checks ranges.
    ///
    /// # Errors
    /// The setting at fault.
    pub fn check(&self) -> Result<(), Refused> {
        if self.ring.is_some() && !self.connections.is_empty() {
            return Err(Refused::new(
                "live.connections",
                "is given together with live.ring",
                "a ring of this node, or connections to relays",
            ));
        }
        let memory = self.memory_gib;
        require(memory.is_finite() && (1e-3..=65_536.0).contains(&memory), "live.memory_gib", memory, "a number from 0.001 to 65536")?;
        for (key, seconds) in
            [("live.block_timeout_seconds", self.block_timeout_seconds), ("live.relay_timeout_seconds", self.relay_timeout_seconds)]
        {
            require((0.01..=86_400.0).contains(&seconds), key, seconds, "a number from 0.01 to 86400")?;
        }
        Ok(())
    }
}
