//! `[publish]` of a scene file.

use crate::setting::{Refused, count, require};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Word for the default endpoint, which only this user reaches: a Unix socket in `$XDG_RUNTIME_DIR/ridgewatch` or `/dev/shm/ridgewatch-UID`.
pub const DEFAULT_ENDPOINT: &str = "private";

/// Whose subscribers are served.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Peers {
    /// Those of this user on this machine.
    User,
    /// Those of all who reach the endpoint.
    Any,
}

impl From<Peers> for ridgewatch_zmtp::Peers {
    fn from(peers: Peers) -> Self {
        match peers {
            Peers::User => Self::User,
            Peers::Any => Self::Any,
        }
    }
}

/// Form of the published picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Payload {
    /// Tone-mapped, 8 bits a channel, lossy.
    Jpeg,
    /// Tone-mapped, 8 bits a channel, lossless.
    Png,
    /// The whole film with its layers, as in the run folder.
    Exr,
    /// Linear R, G, B, A as little-endian f32, rows from the top.
    Raw,
}

/// Frames whose EXR is written to the run folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ExrFrames {
    /// The newest frame of each slide; it replaces the EXR of the frame before.
    Slide,
    /// All.
    Every,
    /// None.
    None,
}

/// Policy when the disk is slower than the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WhenDiskSlow {
    /// The cycle waits for the disk, a minute at most. Default of replays.
    Wait,
    /// The oldest queued picture is dropped and counted; its record is still written. Default of live runs.
    Drop,
}

/// `[publish]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PublishSettings {
    /// ZeroMQ endpoint: `tcp://HOST:PORT` (port 0 binds a free port), `ipc://PATH`, or [`DEFAULT_ENDPOINT`]. `None` (in a file: `"none"`) opens no
    /// socket.
    #[serde(deserialize_with = "endpoint_or_none", serialize_with = "none_as_word")]
    pub endpoint: Option<String>,
    /// Whose subscribers are served. `None`: those of this user if only this machine reaches the endpoint, else all.
    pub peers: Option<Peers>,
    /// Form of the published picture.
    pub payload: Payload,
    /// Maximum number of pictures in flight to subscribers.
    pub frames_in_flight: usize,
    /// Seconds after which a subscriber that is still taking a message is disconnected.
    pub stall_seconds: f64,
    /// Number of newest frames whose pictures are kept. `None` keeps all; for live runs see [`PublishSettings::of_live_run`].
    pub keep: Option<usize>,
    /// Maximum bytes of the pictures in the run folder; `None`: no cap. The newest frame is always kept.
    pub keep_bytes: Option<u64>,
    /// Maximum bytes of the records in the run folder, of which at least the newest half is kept. `None`: no cap; for live runs see
    /// [`PublishSettings::of_live_run`].
    pub records_bytes: Option<u64>,
    /// Whether a PNG of each frame is written.
    pub preview: bool,
    /// Whether a run of a flow in two dimensions writes a map of each slide.
    pub maps: bool,
    /// Frames whose EXR is written.
    pub exr: ExrFrames,
    /// Policy when the disk is slower than the cycle. `None` waits; for live runs see [`PublishSettings::of_live_run`].
    pub when_disk_slow: Option<WhenDiskSlow>,
}

impl Default for PublishSettings {
    fn default() -> Self {
        Self {
            endpoint: None,
            peers: None,
            payload: Payload::Jpeg,
            frames_in_flight: 3,
            stall_seconds: 2.0,
            keep: None,
            keep_bytes: None,
            records_bytes: None,
            preview: true,
            maps: true,
            exr: ExrFrames::Slide,
            when_disk_slow: None,
        }
    }
}

/// Default of `keep` for live runs, which may last weeks.
const LIVE_FRAMES: usize = 100;
/// Default of `records_bytes` for live runs: some 700,000 records.
const LIVE_RECORDS_BYTES: u64 = 1 << 30;
/// Minimum of `records_bytes`. A record has one or two kilobytes.
const MIN_RECORDS_BYTES: u64 = 1 << 20;

impl PublishSettings {
    /// Adds the defaults of a live run, which neither waits for the disk nor fills it.
    pub fn of_live_run(self) -> Self {
        let bounded = self.keep.is_some() || self.keep_bytes.is_some();
        Self {
            keep: if bounded { self.keep } else { Some(LIVE_FRAMES) },
            records_bytes: self.records_bytes.or(Some(LIVE_RECORDS_BYTES)),
            when_disk_slow: self.when_disk_slow.or(Some(WhenDiskSlow::Drop)),
            ..self
        }
    }

    /// Checks ranges.
    ///
    /// # Errors
    /// The first value out of its range.
    pub fn check(&self) -> Result<(), Refused> {
        count("publish.frames_in_flight", self.frames_in_flight, 1, 64)?;
        require((0.1..=3600.0).contains(&self.stall_seconds), "publish.stall_seconds", self.stall_seconds, "a number from 0.1 to 3600")?;
        require(self.keep != Some(0), "publish.keep", 0, "at least 1, or no key to keep all frames")?;
        let records = self.records_bytes.unwrap_or(MIN_RECORDS_BYTES);
        require(
            records >= MIN_RECORDS_BYTES,
            "publish.records_bytes",
            records,
            "at least 1048576, or no key for no cap (of a live run 1073741824)",
        )
    }
}

/// TOML has no null; `"none"` (or an empty string) stands for it.
fn endpoint_or_none<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    Ok(Option::<String>::deserialize(deserializer)?.filter(|s| !s.is_empty() && s != "none"))
}

fn none_as_word<S: Serializer>(endpoint: &Option<String>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(endpoint.as_deref().unwrap_or("none"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_round_trip_and_none_is_a_word() {
        let settings =
            PublishSettings { endpoint: None, peers: Some(Peers::Any), payload: Payload::Raw, keep: Some(3), ..Default::default() };
        let text = toml::to_string(&settings).unwrap();
        assert!(text.contains("endpoint = \"none\""), "{text}");
        assert_eq!(toml::from_str::<PublishSettings>(&text).unwrap(), settings);
        assert_eq!(toml::from_str::<PublishSettings>("").unwrap(), PublishSettings::default());
        assert!(toml::from_str::<PublishSettings>("endpiont = 'none'").is_err());
    }

    #[test]
    fn ranges_are_checked() {
        let bad = [
            PublishSettings { frames_in_flight: 0, ..Default::default() },
            PublishSettings { stall_seconds: f64::NAN, ..Default::default() },
            PublishSettings { keep: Some(0), ..Default::default() },
            PublishSettings { records_bytes: Some(1000), ..Default::default() },
        ];
        for (settings, key) in bad.iter().zip(["frames_in_flight", "stall_seconds", "keep", "records_bytes"]) {
            assert!(settings.check().unwrap_err().to_string().contains(key));
        }
        PublishSettings::default().check().unwrap();
    }
}
