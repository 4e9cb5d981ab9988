//! `ridgewatch relay`.

use super::nice::Nice;
use super::{Common, Usage, messages, print_json};
use anyhow::{Context, Result, bail};
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_wire::relay::{RelayCounts, serve};
use std::net::{IpAddr, TcpListener};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Options of `relay`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// The ring's folder; without it that of the environment variable RIDGEWATCH_RING.
    #[arg(value_name = "RING")]
    ring: Option<PathBuf>,
    /// Where to listen: HOST:PORT; port 0: any free one. Another node needs this node's name or address here.
    #[arg(long, default_value = "127.0.0.1:0", value_name = "HOST:PORT")]
    listen: String,
    /// Writes the address and the key here (mode 0600), for `ridgewatch attach` on the other node.
    #[arg(long, value_name = "FILE")]
    connection: PathBuf,
    #[command(flatten)]
    nice: Nice,
}

/// What is odd about a listener that was asked for by `host` and got this address: a name that other nodes know may stand for this machine's own
/// loopback here (127.0.1.1 in Debian's /etc/hosts).
fn out_of_reach(host: &str, address: IpAddr) -> Option<String> {
    let meant = host == "localhost" || host.trim_matches(['[', ']']).parse::<IpAddr>().is_ok();
    (address.is_loopback() && !meant).then(|| {
        format!("{host} stands for {address} on this machine, which no other node reaches: give --listen the address that they reach it by")
    })
}

/// Relays until it is told to stop.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    if !common.overrides.is_empty() {
        bail!(Usage("--set: relay takes no scene; accepted: RING, --listen, --connection, --nice".into()));
    }
    let named = ridgewatch_wire::ring_from_environment;
    let Some(ring) = options.ring.clone().or_else(named) else {
        bail!(Usage(format!("no ring: name its folder, or set {}", ridgewatch_wire::RING_VARIABLE)));
    };
    let listener = TcpListener::bind(&options.listen).with_context(|| format!("cannot listen at {}", options.listen))?;
    let (address, port) = (listener.local_addr()?.ip(), listener.local_addr()?.port());
    let host = options.listen.rsplit_once(':').map_or("127.0.0.1", |(host, _)| host);
    if let Some(warning) = out_of_reach(host, address) {
        messages::note(warning);
    }
    options.nice.step_back();
    super::open_files::allow_many();
    let key = Key::random()?;
    super::check_folder(&options.connection)?;
    let (stop, counts) = (Arc::new(AtomicBool::new(false)), Arc::new(RelayCounts::default()));
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().context("cannot start the I/O thread")?;
    let connection = ConnectionFile { address: format!("{host}:{port}"), key: key.clone() };
    let served = runtime.block_on(async {
        // Before the file is there, so that no signal leaves it behind.
        let signals = super::replay::watch_signals(stop.clone(), Arc::default()).map(tokio::spawn);
        connection.write(&options.connection)?;
        messages::note(format_args!(
            "relaying {} at {host}:{port}; on the other node: ridgewatch attach {}",
            ring.display(),
            options.connection.display()
        ));
        let (flag, counts) = (stop.clone(), counts.clone());
        let work = move || serve(&ring, &listener, &key, &counts, &flag, Arc::new(messages::note));
        let served = tokio::task::spawn_blocking(work).await;
        if let Some(signals) = signals {
            signals.abort();
        }
        anyhow::Ok(served)
    })?;
    // Whoever reads it later would wait for nobody.
    connection.remove(&options.connection);
    served.context("the relay stopped unexpectedly")??;
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
