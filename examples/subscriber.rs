//! Prints a line for each frame that ridgewatch publishes, and saves the pictures if asked.
//!
//! ```text
//! cargo run --release --example subscriber                                      # frames of `--publish`
//! cargo run --release --example subscriber -- tcp://127.0.0.1:5577 pictures     # frames of `--publish tcp://127.0.0.1:5577`
//! ```
#![allow(clippy::print_stdout)]

use anyhow::{Context, bail};
use serde_json::Value;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use zeromq::{Socket, SocketOptions, SocketRecv, SubSocket, ZmqError, ZmqMessage, ZmqResult};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let endpoint = arguments.next().map_or_else(|| ridgewatch_zmtp::private_endpoint("frames"), Ok)?;
    let save = arguments.next().map(PathBuf::from);
    if let Some(folder) = &save {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }

    let mut socket = connect(&endpoint).await.with_context(|| endpoint.clone())?;
    socket.subscribe("frame").await?;

    let mut last: Option<Instant> = None;
    loop {
        let message = tokio::select! {
            message = socket.recv() => message,
            _ = tokio::signal::ctrl_c() => return Ok(()),
        };
        let message = match message {
            Ok(message) => message,
            Err(error) => {
                // A message torn by a disconnect is an error; the connection is restored in the background.
                eprintln!("{error}");
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let gap = last.replace(Instant::now()).map_or(0.0, |before| before.elapsed().as_secs_f64());
        match show(&message, gap, save.as_deref()) {
            Ok(line) => println!("{line}"),
            Err(error) => eprintln!("not understood: {error:#}"),
        }
    }
}

/// Connects as soon as the publisher is there. After a disconnect the socket connects again by itself.
async fn connect(endpoint: &str) -> ZmqResult<SubSocket> {
    loop {
        let mut options = SocketOptions::default();
        // Otherwise the pauses between attempts grow to half a minute, and after half a minute it is an error.
        options.connect_timeout(Duration::from_secs(1));
        let mut socket = SubSocket::with_options(options);
        match socket.connect(endpoint).await {
            Err(ZmqError::ConnectTimeout(_)) => {}
            connected => return connected.map(|()| socket),
        }
    }
}

fn show(message: &ZmqMessage, gap: f64, save: Option<&std::path::Path>) -> anyhow::Result<String> {
    let (Some(header), Some(payload)) = (message.get(1), message.get(2)) else { bail!("{} parts", message.len()) };
    let header: Value = serde_json::from_slice(header)?;
    let length = header["payload_bytes"].as_u64().context("no payload_bytes")?;
    if header["protocol"] != 3 || length != payload.len() as u64 {
        bail!("protocol {}, {} of {length} bytes", header["protocol"], payload.len());
    }
    let number = header["frame"].as_u64().context("no frame number")?;
    let encoding = header["encoding"].as_str().context("no encoding")?;
    if let Some(folder) = save {
        let suffix = match encoding {
            "jpeg" => "jpg",
            "raw" => "f32",
            other => other,
        };
        std::fs::write(folder.join(format!("frame_{number:06}.{suffix}")), payload)?;
    }
    let (record, shape) = (&header["record"], &header["shape"]);
    let traced = 100.0 * record["traced_share"].as_f64().unwrap_or(f64::NAN);
    // Live runs: age of the newest step, if both programs share a clock.
    let behind = record["live"]["published"].as_f64().map(|published| {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64());
        format!(", {:.4} s behind the simulation", now - published)
    });
    let stated = record["picture_error"]["psnr"]["value"].as_f64().map(|decibels| format!(", {decibels:.1} dB stated"));
    Ok(format!(
        "frame {number}: time {}, {}x{} {encoding}, {length} bytes, traced {traced:.1} %{}, gap {gap:.3} s{}",
        record["time"],
        shape[1],
        shape[0],
        stated.unwrap_or_default(),
        behind.unwrap_or_default()
    ))
}
