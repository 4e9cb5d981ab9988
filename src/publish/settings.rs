//! `[publish]` of a scene file.

use crate::setting::{Refused, count, require};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Where frames go unless told otherwise: this machine only.
pub const DEFAULT_ENDPOINT: &str = "tcp://127.0.0.1:5577";

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

impl Payload {
    /// Name in the header's `encoding`.
    pub fn name(self) -> &'static str {
        match self {
            Payload::Jpeg => "jpeg",
            Payload::Png => "png",
            Payload::Exr => "exr",
            Payload::Raw => "raw",
        }
    }
}

/// Which frames leave an EXR in the run folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ExrFrames {
    /// One for each slide of the window: that of its newest frame, which replaces that of the frame before.
    Slide,
    /// All.
    Every,
    /// None.
    None,
}

/// What happens to a frame when the disk is slower than the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WhenDiskSlow {
    /// The cycle waits for the disk (replay: nothing is lost), for a minute at most.
    Wait,
    /// The oldest waiting picture is dropped and counted (live: the cycle never waits). Its record is still written.
    Drop,
}

/// `[publish]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PublishSettings {
    /// ZeroMQ endpoint, `tcp://HOST:PORT`; None (in a file: `"none"`) opens no socket. Port 0 takes a free one.
    #[serde(deserialize_with = "endpoint_or_none", serialize_with = "none_as_word")]
    pub endpoint: Option<String>,
    /// Form of the published picture.
    pub payload: Payload,
    /// Pictures that may be on their way to subscribers at once.
    pub frames_in_flight: usize,
    /// Seconds after which a subscriber that still holds a picture is cut off.
    pub stall_seconds: f64,
    /// Newest frames whose pictures stay in the run folder; None keeps all, but of a live run see [`PublishSettings::of_live_run`].
    pub keep: Option<usize>,
    /// Bytes that the pictures in the run folder may take; None sets no cap. The newest frame always stays.
    pub keep_bytes: Option<u64>,
    /// Bytes that the records in the run folder may take: the newest half of them at least stays. None sets no cap, but of a live run see
    /// [`PublishSettings::of_live_run`].
    pub records_bytes: Option<u64>,
    /// Whether a PNG of each frame is written.
    pub preview: bool,
    /// Of which frames an EXR is written.
    pub exr: ExrFrames,
    /// What happens when the disk is slower than the cycle; None waits, but of a live run see [`PublishSettings::of_live_run`].
    pub when_disk_slow: Option<WhenDiskSlow>,
}

impl Default for PublishSettings {
    fn default() -> Self {
        Self {
            endpoint: None,
            payload: Payload::Jpeg,
            frames_in_flight: 3,
            stall_seconds: 2.0,
            keep: None,
            keep_bytes: None,
            records_bytes: None,
            preview: true,
            exr: ExrFrames::Slide,
            when_disk_slow: None,
        }
    }
}

/// Newest frames whose pictures stay of a live run, which may go on for weeks, unless told otherwise.
const LIVE_FRAMES: usize = 100;
/// Bytes of its records: some 700,000 of them.
const LIVE_RECORDS: u64 = 1 << 30;
/// Least cap on the bytes of records, which are one or two kilobytes each.
const LEAST_RECORDS: u64 = 1 << 20;

impl PublishSettings {
    /// These of a run that follows a simulation: what is not set neither waits for the disk nor fills it.
    pub fn of_live_run(self) -> Self {
        // Who caps the bytes has set a bound.
        let bounded = self.keep.is_some() || self.keep_bytes.is_some();
        Self {
            keep: if bounded { self.keep } else { Some(LIVE_FRAMES) },
            records_bytes: self.records_bytes.or(Some(LIVE_RECORDS)),
            when_disk_slow: self.when_disk_slow.or(Some(WhenDiskSlow::Drop)),
            ..self
        }
    }

    /// Checks ranges that the types do not.
    pub fn check(&self) -> Result<(), Refused> {
        count("publish.frames_in_flight", self.frames_in_flight, 1, 64)?;
        require((0.1..=3600.0).contains(&self.stall_seconds), "publish.stall_seconds", self.stall_seconds, "a number from 0.1 to 3600")?;
        require(self.keep != Some(0), "publish.keep", 0, "at least 1, or no key to keep all frames")?;
        let records = self.records_bytes.unwrap_or(LEAST_RECORDS);
        require(
            records >= LEAST_RECORDS,
            "publish.records_bytes",
            records,
            "at least 1048576, or no key for no cap (of a live run 1073741824)",
        )
    }
}

/// TOML has no null, so that `"none"` (or an empty string) says it.
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
    fn reads_what_it_writes_and_knows_none() {
        let settings = PublishSettings { endpoint: None, payload: Payload::Raw, keep: Some(3), ..Default::default() };
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
