//! `ridgewatch dashboard`, and the dashboard beside a run.

use super::common::{Common, Usage, print_json, print_text};
use super::messages;
use anyhow::{Context, Result, bail};
use ridgewatch::dashboard::{Dashboard, DashboardSettings, Token};
use ridgewatch::publish::{DEFAULT_ENDPOINT, NewestFrame};
use ridgewatch::steer::default_connection;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::sync::Arc;
use tokio::signal::unix::{SignalKind, signal};

/// Options of `dashboard`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Where frames are published (`--publish`): private, ipc://PATH or tcp://HOST:PORT.
    #[arg(value_name = "ENDPOINT", default_value = DEFAULT_ENDPOINT)]
    endpoint: String,
    /// Port of the page; 0: any free one. By default 8577, or any free one if that is taken.
    #[arg(long, value_name = "PORT")]
    port: Option<u16>,
    /// Address to listen at. Others than 127.0.0.1 let other machines reach the page, by this address or a name of --allow-host, without
    /// encryption.
    #[arg(long, value_name = "ADDRESS", default_value_t = Ipv4Addr::LOCALHOST.into())]
    bind: IpAddr,
    /// Name by which browsers reach the page through a proxy, as in their address bar; may be repeated.
    #[arg(long, value_name = "NAME")]
    allow_host: Vec<String>,
    /// Keep the token in this file (mode 0600), which is made if it does not exist, and print the address without it.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Let the page steer the run whose connection file this is (`replay --steer`, `attach --steer`); by default the one of the private socket.
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true)]
    steer: Option<Option<PathBuf>>,
    /// Show this chart of speed against accuracy, a chart.svg of `ridgewatch chart`.
    #[arg(long, value_name = "FILE")]
    chart: Option<PathBuf>,
}

/// Serves the page until a signal comes.
pub fn run(common: &Common, options: Options) -> Result<()> {
    if !common.overrides.is_empty() {
        bail!(Usage(
            "--set: dashboard has no scene; accepted: ENDPOINT, --port, --bind, --allow-host, --token-file, --steer, --chart".into()
        ));
    }
    let Options { endpoint, port, bind: address, allow_host: hosts, token_file, steer, chart } = options;
    let steer = steer.map(|file| file.map_or_else(default_connection, Ok)).transpose()?;
    let token = token_file.as_deref().map_or_else(|| Ok(Token::random()?), Token::in_file)?;
    let is_steered = steer.is_some();
    let read = |file: PathBuf| std::fs::read(&file).with_context(|| format!("cannot read {}", file.display()));
    let chart = chart.map(read).transpose()?;
    let dashboard = Dashboard::start(DashboardSettings { endpoint, address, port, hosts, token, steer, newest: None, chart })?;
    if !address.is_loopback() {
        messages::note(format_args!(
            "{} is open to other machines: without encryption, whoever reads the network sees frames and token",
            dashboard.address()
        ));
    }
    messages::note(format_args!("frames from {}", dashboard.endpoint()));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        // SIGHUP keeps its meaning: under `nohup` it is ignored.
        let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
        announce(&dashboard, common.json, token_file.is_some(), is_steered)?;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        Ok(())
    })
}

/// Starts a dashboard beside a run that publishes at `endpoint`, keeps its newest frame, and takes commands if it has a connection file. Without one
/// the run goes on.
pub fn beside(
    common: &Common,
    endpoint: String,
    port: Option<u16>,
    steer: Option<PathBuf>,
    newest: Arc<NewestFrame>,
    chart: Option<Vec<u8>>,
) -> Option<Dashboard> {
    let is_steered = steer.is_some();
    let started = Token::random().map_err(Into::into).and_then(|token| {
        Dashboard::start(DashboardSettings { steer, newest: Some(newest), chart, ..DashboardSettings::local(endpoint, port, token) })
    });
    match started {
        Ok(dashboard) => {
            if let Err(error) = announce(&dashboard, common.json, false, is_steered) {
                messages::note(format_args!("the address of the dashboard cannot be printed: {error}"));
            }
            Some(dashboard)
        }
        Err(error) => {
            messages::note(format_args!("there is no dashboard: {error}"));
            None
        }
    }
}

/// Prints the address on standard output, since standard error often goes to a log that others may read.
fn announce(dashboard: &Dashboard, json: bool, keeps_token: bool, is_steered: bool) -> Result<()> {
    let address = dashboard.address();
    let url = if keeps_token { format!("http://{address}/") } else { dashboard.url() };
    // Where nothing is steered, one address does.
    let watching = Some(dashboard.watching_url()).filter(|_| is_steered && !keeps_token);
    if json {
        return print_json(&match watching {
            Some(watching) => serde_json::json!({ "url": url, "watching_url": watching }),
            None => serde_json::json!({ "url": url }),
        });
    }
    let token = if keeps_token { "?token= and the text of the token file" } else { "" };
    print_text(format_args!("dashboard: {url}{token}"));
    if let Some(watching) = watching {
        print_text(format_args!("for those who only watch: {watching}"));
    }
    if address.ip().is_loopback() {
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let (port, host) = (address.port(), host.trim());
        let host = if host.is_empty() { "HOST" } else { host };
        print_text(format_args!("from another machine: ssh -L {port}:{address} {host}, then the same address there"));
    }
    Ok(())
}
