//! `ridgewatch relay`.

use super::common::{Common, check_folder, print_json, refuse_settings, ring_folder};
use super::process::Nice;
use super::{messages, signals};
use anyhow::{Context, Result};
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_wire::relay::{RelayCounts, serve};
use std::net::{IpAddr, TcpListener};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Options of `relay`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// The ring folder; by default the environment variable RIDGEWATCH_RING names it.
    #[arg(value_name = "RING")]
    ring: Option<PathBuf>,
    /// Address to listen at, HOST:PORT; port 0: any free one. Other nodes need the name or address of this node here.
    #[arg(long, default_value = "127.0.0.1:0", value_name = "HOST:PORT")]
    listen: String,
    /// File for the address and the key (mode 0600), for `ridgewatch attach` on the other node.
    #[arg(long, value_name = "FILE")]
    connection: PathBuf,
    #[command(flatten)]
    nice: Nice,
}

/// Warning for a listener that other nodes do not reach: `host` may stand for the loopback on this machine, as 127.0.1.1 in Debian's
/// /etc/hosts.
fn out_of_reach(host: &str, address: IpAddr) -> Option<String> {
    let meant = host == "localhost" || host.trim_matches(['[', ']']).parse::<IpAddr>().is_ok();
    (address.is_loopback() && !meant).then(|| {
        format!("{host} stands for {address} on this machine, which no other node reaches: give --listen the address that they reach it by")
    })
}

/// Relays until a signal.
pub fn run(common: &Common, options: Options) -> Result<()> {
    refuse_settings(common, "relay", "RING, --listen, --connection, --nice")?;
    let ring = ring_folder(options.ring.as_deref())?;
    let listener = TcpListener::bind(&options.listen).with_context(|| format!("cannot listen at {}", options.listen))?;
    let (address, port) = (listener.local_addr()?.ip(), listener.local_addr()?.port());
    let host = options.listen.rsplit_once(':').map_or("127.0.0.1", |(host, _)| host);
    if let Some(warning) = out_of_reach(host, address) {
        messages::note(warning);
    }
    options.nice.apply();
    let key = Key::random()?;
    check_folder(&options.connection)?;
    let (counts, path) = (Arc::new(RelayCounts::default()), options.connection);
    let connection = ConnectionFile { address: format!("{host}:{port}"), key: key.clone() };
    // However it ends, no key stays behind.
    let last = {
        let (connection, path) = (connection.clone(), path.clone());
        move || connection.remove(&path)
    };
    signals::until_stopped(last, |stop| {
        connection.write(&path)?;
        messages::note(format_args!(
            "relaying {} at {}; on the other node: ridgewatch attach {}",
            ring.display(),
            connection.address,
            path.display()
        ));
        let served = serve(&ring, &listener, &key, &counts, stop, Arc::new(messages::note));
        // So that nobody waits for a relay that has ended.
        connection.remove(&path);
        Ok(served?)
    })?;
    if common.json {
        let count = |c: &std::sync::atomic::AtomicU64| c.load(Ordering::Relaxed);
        print_json(&serde_json::json!({
            "accepted": count(&counts.accepted),
            "refused": count(&counts.refused),
            "steps": count(&counts.steps),
            "bytes": count(&counts.bytes),
        }))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(clippy::unwrap_used)]
    fn a_name_that_stands_for_the_loopback_is_warned_of() {
        for (host, address, odd) in [
            ("node17", "127.0.1.1", true),
            ("node17", "::1", true),
            ("node17", "10.0.0.17", false),
            ("localhost", "127.0.0.1", false),
            ("127.0.0.1", "127.0.0.1", false),
            ("[::1]", "::1", false),
            ("0.0.0.0", "0.0.0.0", false),
        ] {
            let warning = out_of_reach(host, address.parse().unwrap());
            assert_eq!(warning.is_some(), odd, "{host} {address}");
            assert!(warning.is_none_or(|words| words.contains(host) && words.contains(address)));
        }
    }
}
