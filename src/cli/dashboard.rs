//! `ridgewatch dashboard`, and the dashboard beside a run.

use super::common::{Common, Usage, print_json, print_text, refuse_settings};
use super::messages;
use anyhow::{Context, Result, bail};
use ridgewatch::dashboard::{Dashboard, DashboardSettings, Token, host_name};
use ridgewatch::publish::DEFAULT_ENDPOINT;
use ridgewatch::steer::default_connection;
use std::net::IpAddr;
use std::path::PathBuf;
use tokio::signal::unix::{SignalKind, signal};

/// Who reaches a page: options of `dashboard`, and of a run with `--dashboard`.
#[derive(Debug, clap::Args)]
pub struct Reach {
    /// Address at which the page listens, by default 127.0.0.1. Others let other machines reach it, by this address or a name of --allow-host,
    /// without encryption.
    #[arg(long, value_name = "ADDRESS")]
    bind: Option<IpAddr>,
    /// Name by which browsers reach the page through a proxy, as in their address bar; may be repeated.
    #[arg(long, value_name = "NAME", value_parser = host_name)]
    allow_host: Vec<String>,
    /// Keep the page's token in this file (mode 0600), which is made if it does not exist, and print the address without it.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

impl Reach {
    /// Settings of a page of the private endpoint. Makes the token's file if it does not exist.
    pub fn settings(&self, port: Option<u16>) -> Result<DashboardSettings> {
        let token = self.token_file.as_deref().map_or_else(|| Ok(Token::random()?), Token::in_file)?;
        let local = DashboardSettings::local(DEFAULT_ENDPOINT.to_owned(), port, token);
        Ok(DashboardSettings { address: self.bind.unwrap_or(local.address), hosts: self.allow_host.clone(), ..local })
    }

    /// Refuses these options for a run without a page.
    pub fn refuse_without_page(&self) -> Result<()> {
        let bind = self.bind.map(|address| format!("--bind {address}"));
        let host = self.allow_host.first().map(|name| format!("--allow-host {name}"));
        let file = self.token_file.as_ref().map(|file| format!("--token-file {}", file.display()));
        match bind.or(host).or(file) {
            Some(option) => bail!(Usage(format!("{option}: this run has no page; accepted with --dashboard"))),
            None => Ok(()),
        }
    }
}

/// Options of `dashboard`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Where frames are published (`--publish`): private, ipc://PATH or tcp://HOST:PORT.
    #[arg(value_name = "ENDPOINT", default_value = DEFAULT_ENDPOINT)]
    endpoint: String,
    /// Port of the page; 0: any free one. By default 8577, or any free one if that is taken.
    #[arg(long, value_name = "PORT")]
    port: Option<u16>,
    #[command(flatten)]
    reach: Reach,
    /// Let the page steer the run whose connection file this is (`replay --steer`, `attach --steer`); by default the one of the private socket.
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true)]
    steer: Option<Option<PathBuf>>,
    /// Folder of the run (`--out`), whose kept frames and records pages look back to.
    #[arg(long, value_name = "FOLDER")]
    run: Option<PathBuf>,
    /// Show this chart of speed against accuracy, a chart.svg of `ridgewatch chart`.
    #[arg(long, value_name = "FILE")]
    chart: Option<PathBuf>,
}

/// Serves the page until a signal comes.
pub fn run(common: &Common, options: Options) -> Result<()> {
    refuse_settings(common, "dashboard", "ENDPOINT, --port, --bind, --allow-host, --token-file, --steer, --run, --chart")?;
    let Options { endpoint, port, reach, steer, run, chart } = options;
    if let Some(run) = run.as_deref().filter(|run| !run.is_dir()) {
        bail!(Usage(format!("--run {}: no such folder; accepted: the folder of a run (--out of replay and attach)", run.display())));
    }
    let steer = steer.map(|file| file.map_or_else(default_connection, Ok)).transpose()?;
    let is_steered = steer.is_some();
    let read = |file: PathBuf| std::fs::read(&file).with_context(|| format!("cannot read {}", file.display()));
    let chart = chart.map(read).transpose()?;
    let dashboard = Dashboard::start(DashboardSettings { endpoint, steer, run, chart, ..reach.settings(port)? })?;
    note_if_open(&dashboard);
    messages::note(format_args!("frames from {}", dashboard.endpoint()));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        // SIGHUP keeps its meaning: under `nohup` it is ignored.
        let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
        announce(&dashboard, common.json, &reach, is_steered)?;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        Ok(())
    })
}

/// Starts the dashboard of a run. Without one the run goes on.
pub fn beside(common: &Common, reach: &Reach, settings: DashboardSettings) -> Option<Dashboard> {
    let is_steered = settings.steer.is_some();
    match Dashboard::start(settings) {
        Ok(dashboard) => {
            note_if_open(&dashboard);
            if let Err(error) = announce(&dashboard, common.json, reach, is_steered) {
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

/// Warns of an address that other machines reach.
fn note_if_open(dashboard: &Dashboard) {
    let address = dashboard.address();
    if !address.ip().is_loopback() {
        messages::note(format_args!(
            "{address} is open to other machines: without encryption, whoever reads the network sees frames and token"
        ));
    }
}

/// Prints the address on standard output, since standard error often goes to a log that others may read.
fn announce(dashboard: &Dashboard, json: bool, reach: &Reach, is_steered: bool) -> Result<()> {
    let (address, keeps_token) = (dashboard.address(), reach.token_file.is_some());
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
