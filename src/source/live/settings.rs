//! `[live]` of a scene file.

use crate::setting::{Refused, require};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What happens while a frame is being made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Follow {
    /// The window goes on filling; the next frame is of the newest.
    #[default]
    Newest,
    /// No step is taken before the slide that it belongs to: a producer whose policy is to wait is slowed to the frames' pace.
    Every,
}

/// What happens when the simulation has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AtEnd {
    /// Its restart is waited for.
    #[default]
    Wait,
    /// The run ends too.
    Stop,
}

/// `[live]`: a simulation that runs now.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LiveSettings {
    /// Folder of the ring on this node; none: that of the environment variable `RIDGEWATCH_RING`, or a relay.
    pub ring: Option<PathBuf>,
    /// Connection files of relays on other nodes, instead of a ring.
    pub connections: Vec<PathBuf>,
    /// GiB of memory for the window, the one that the current frame uses, and what is on its way to them: steps that wait for their blocks, and buffers.
    pub memory_gib: f64,
    /// Newest steps or every step.
    pub follow: Follow,
    /// Wait for a restart or stop.
    pub at_end: AtEnd,
    /// Seconds that a step waits for its missing blocks.
    pub block_timeout_seconds: f64,
    /// Seconds that a relay may be out of reach before its blocks count as ended.
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
    /// Checks ranges.
    pub fn check(&self) -> Result<(), Refused> {
        if self.ring.is_some() && !self.connections.is_empty() {
            return Err(Refused::new("live.connections", "are given beside live.ring", "a ring of this node, or connections to relays"));
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
