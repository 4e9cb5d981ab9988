//! The command line, one file a command.

mod attach;
mod chart;
mod clean;
mod common;
mod compare;
mod dashboard;
mod doctor;
mod figure;
mod ftle;
mod inspect;
mod map;
pub mod messages;
mod notify;
mod process;
mod publish;
mod relay;
mod render;
mod replay;
mod ridges;
mod session;
mod signals;
mod synthesize;
mod train;

use anyhow::Result;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, Parser, Subcommand};
use common::Common;
pub use common::exit_status;
use ridgewatch::config::renamed;

/// Shows the Lagrangian coherent structures of a flow simulation while it runs.
#[derive(Debug, Parser)]
#[command(name = "ridgewatch", version, max_term_width = 110, propagate_version = true)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    pub common: Common,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run over an archive or a closed-form flow, and write frames, records and a summary into a folder.
    Replay(replay::Options),
    /// Run beside a simulation: wait for it, follow it, and continue after its restart.
    Attach(attach::Options),
    /// Show the published frames on a web page, on this machine only.
    Dashboard(dashboard::Options),
    /// Publish an archive into a ring, as a simulation does.
    Publish(publish::Options),
    /// Send the rings of this node to ridgewatch on another node.
    Relay(relay::Options),
    /// Remove rings from shared memory that no living process holds.
    Clean(clean::Options),
    /// Render one picture.
    Render(render::Options),
    /// Compute the FTLE field on a grid as NetCDF; `--check` compares it with the truth.
    Ftle(ftle::Options),
    /// Draw the FTLE of one moment as a map, with its ridge lines.
    Map(map::Options),
    /// Write the ridges of the FTLE of one moment as geometry: lines in two dimensions, surfaces in three.
    Ridges(ridges::Options),
    /// Draw a frame of a run as a page with its colour bar, time, method and stated error.
    Figure(figure::Options),
    /// Chart speed against accuracy of a scene: methods and settings, the Pareto front, and the pick.
    Chart(chart::Options),
    /// Train the scene's network offline on a still window, and show how its error falls.
    Train(train::Options),
    /// Compare two EXR pictures: PSNR, SSIM, relative error.
    Compare(compare::Options),
    /// Show how files would be read, and why.
    Inspect(inspect::Options),
    /// Write an archive of the standard turbulence in the format of ECMWF or of a flame simulation.
    Synthesize(synthesize::Options),
    /// Show the devices and libraries found.
    Doctor,
}

impl Arguments {
    /// Parses the process's command line.
    ///
    /// # Errors
    /// clap's, which also stands for `--help` and `--version`. An option that was renamed is refused with its new name.
    pub fn read() -> Result<Self, clap::Error> {
        Self::try_parse().map_err(|error| {
            let Some(ContextValue::String(option)) = error.get(ContextKind::InvalidArg) else { return error };
            match renamed(option).filter(|_| error.kind() == ErrorKind::UnknownArgument) {
                Some(new) => Self::command().error(ErrorKind::UnknownArgument, format!("`{option}` has a new name; accepted: `{new}`")),
                None => error,
            }
        })
    }
}

/// Runs a command.
pub fn run(arguments: Arguments) -> Result<()> {
    let common = arguments.common;
    // The pool of all work without its own pool, such as conversions and copies. 0 means one thread a core.
    rayon::ThreadPoolBuilder::new().num_threads(common.threads).build_global()?;
    let done = match arguments.command {
        Command::Replay(options) => replay::run(&common, options),
        Command::Attach(options) => attach::run(&common, options),
        Command::Dashboard(options) => dashboard::run(&common, options),
        Command::Publish(options) => publish::run(&common, options),
        Command::Relay(options) => relay::run(&common, options),
        Command::Clean(options) => clean::run(&common, &options),
        Command::Render(options) => render::run(&common, options),
        Command::Ftle(options) => ftle::run(&common, &options),
        Command::Map(options) => map::run(&common, &options),
        Command::Ridges(options) => ridges::run(&common, &options),
        Command::Figure(options) => figure::run(&common, &options),
        Command::Chart(options) => chart::run(&common, &options),
        Command::Train(options) => train::run(&common, &options),
        Command::Compare(options) => compare::run(&common, &options),
        Command::Inspect(options) => inspect::run(&common, &options),
        Command::Synthesize(options) => synthesize::run(&common, &options),
        Command::Doctor => doctor::run(&common),
    };
    done.and_then(|()| common::lost_text())
}
