//! MP4 (H.264) by the program `ffmpeg`: frames go to its standard input, and its output is the film's file, opened here. The film is fragmented, so
//! that it can be played up to the last fragment whenever it ends.

use super::Encoder;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdin, Command, Stdio};

/// Largest part of ffmpeg's messages that an error quotes, in bytes.
const QUOTED: u64 = 500;

/// Seconds of film in a fragment, of which an interruption costs the last.
const FRAGMENT_SECONDS: f64 = 2.0;

pub(super) struct Mp4 {
    child: Child,
    input: Option<ChildStdin>,
    messages: File,
}

/// Checks that `ffmpeg` can be started and encodes H.264.
pub(super) fn check() -> Result<(), String> {
    let missing = |what: String| {
        format!(
            "{what}: films in MP4 are encoded by the program ffmpeg with libx264. Install it (Debian: apt install ffmpeg), or choose a name that \
             ends in .gif, which needs no program"
        )
    };
    let asked = Command::new("ffmpeg").args(["-hide_banner", "-loglevel", "error", "-encoders"]).stdin(Stdio::null()).output();
    let known = asked.map_err(|error| missing(format!("ffmpeg cannot be started ({error})")))?;
    if !String::from_utf8_lossy(&known.stdout).contains("libx264") {
        return Err(missing("the ffmpeg of this machine has no libx264".into()));
    }
    Ok(())
}

impl Mp4 {
    pub(super) fn new(file: File, [width, height]: [usize; 2], frames_per_second: f64) -> io::Result<Self> {
        let messages = tempfile::tempfile()?;
        let (size, rate) = (format!("{width}x{height}"), frames_per_second.to_string());
        let fragment = ((frames_per_second * FRAGMENT_SECONDS).round() as u64).max(1).to_string();
        let mut command = Command::new("ffmpeg");
        command.args([
            "-hide_banner",
            "-loglevel",
            "error",
            "-f",
            "rawvideo",
            "-pix_fmt",
            "rgb24",
            "-s",
            &size,
            "-r",
            &rate,
            "-i",
            "pipe:0",
        ]);
        // Edges of 4:2:0 are even; colours are those of BT.709, and say so.
        command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv", "-pix_fmt", "yuv420p"]);
        command.args(["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]);
        // One thread, since a simulation may run beside it.
        command.args(["-c:v", "libx264", "-preset", "veryfast", "-crf", "18", "-g", &fragment, "-threads", "1"]);
        command.args(["-movflags", "frag_keyframe+empty_moov+default_base_moof", "-f", "mp4", "pipe:1"]);
        command.stdin(Stdio::piped()).stdout(file).stderr(messages.try_clone()?);
        // A signal from the terminal ends the run in order, and then the film; it does not end ffmpeg before.
        command.process_group(0);
        let mut child = command.spawn()?;
        let input = child.stdin.take();
        Ok(Self { child, input, messages })
    }

    /// The end of ffmpeg's messages.
    fn said(&mut self) -> String {
        let mut bytes = Vec::new();
        let length = self.messages.metadata().map_or(0, |about| about.len());
        let read = self.messages.seek(SeekFrom::Start(length.saturating_sub(QUOTED))).and_then(|_| self.messages.read_to_end(&mut bytes));
        match read {
            Ok(_) if !bytes.is_empty() => String::from_utf8_lossy(&bytes).trim().replace('\n', "; "),
            _ => "without a message".into(),
        }
    }

    /// Waits for the end of ffmpeg, whose input is closed.
    fn end(&mut self) -> io::Result<()> {
        self.input = None;
        let status = self.child.wait()?;
        if status.success() { Ok(()) } else { Err(io::Error::other(format!("ffmpeg failed ({status}): {}", self.said()))) }
    }
}

impl Encoder for Mp4 {
    fn add(&mut self, rgb: &[u8]) -> io::Result<()> {
        let Some(input) = &mut self.input else { return Err(io::Error::other("ffmpeg has ended")) };
        // A closed pipe says less than ffmpeg does.
        input.write_all(rgb).or_else(|error| self.end().and(Err(error)))
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        self.end()
    }
}
