//! `ridgewatch figure`: a frame of a run as a page for a talk or a paper.

use super::common::{Common, Usage, check_folder, print_json, print_text};
use anyhow::{Context, Result, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::files::write_whole;
use ridgewatch::map::FramePage;
use ridgewatch::publish::PastRun;
use ridgewatch::render::{MAP_TONE, Method};
use ridgewatch::run::ColorBar;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Options of `figure`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Folder of a run, as `replay` and `attach` write it.
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Page: .png or .svg.
    #[arg(long, short, default_value = "out/figure.png")]
    out: PathBuf,
    /// Number of the frame. Default: the newest whose picture is kept.
    #[arg(long, value_name = "N")]
    frame: Option<u64>,
    /// Width of the page in pixels.
    #[arg(long, default_value_t = 1200, value_name = "PIXELS", value_parser = clap::value_parser!(u64).range(320..=4096))]
    width: u64,
}

#[derive(Serialize)]
struct Report<'a> {
    frame: u64,
    size: [usize; 2],
    file: &'a Path,
}

/// Draws the page.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let Options { run, out, .. } = options;
    let extension = out.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    if !["png", "svg"].contains(&extension.as_str()) {
        bail!(Usage(format!("--out {}: accepted: a name that ends in .png or .svg", out.display())));
    }
    let past = PastRun::open(run)?;
    let Some(frame) = options.frame.or_else(|| past.kept().next_back()) else {
        bail!("{} keeps no pictures: there is nothing to draw", run.display());
    };
    if !past.keeps(frame) {
        bail!(Usage(format!("--frame {frame}: its picture is not in {}; accepted: {}", run.display(), ranges(past.kept()))));
    }
    let Some(record) = past.record(frame)? else {
        bail!("{}: no record of frame {frame} is left; accepted: a frame that has one (--frame N)", run.display());
    };
    // The text alone is read: a figure opens no source.
    let path = run.join("scene.toml");
    let text =
        ridgewatch::files::open(&path).and_then(std::io::read_to_string).with_context(|| format!("cannot read {}", path.display()))?;
    let scene = SceneFile::parse(&path, &text, &common.overrides)?;
    let colours = ColorBar::of(&scene.settings(), &record).map_err(|why| {
        anyhow::anyhow!("{}: the record of frame {frame} {why}; `ridgewatch replay {}` repeats the run", run.display(), path.display())
    })?;
    check_folder(out)?;
    let tone_map = if record.method == Method::Map.name() { MAP_TONE } else { scene.render.tone_map };
    let picture = past.picture(&record, tone_map)?;
    let page = FramePage::new(picture, &record, &colours, &scene.title, options.width as usize)?;
    let bytes = if extension == "svg" { page.svg()?.into_bytes() } else { page.png()? };
    write_whole(out, &bytes).with_context(|| format!("cannot write {}", out.display()))?;
    let size = page.size();
    if common.json {
        return print_json(&Report { frame, size, file: out });
    }
    print_text(format_args!("{}: frame {frame} of {}, {} x {} pixels", out.display(), run.display(), size[0], size[1]));
    Ok(())
}

/// Numbers in words: `0, 3 to 7`.
fn ranges(numbers: impl Iterator<Item = u64>) -> String {
    let mut found: Vec<[u64; 2]> = Vec::new();
    for number in numbers {
        match found.last_mut() {
            Some([_, last]) if *last + 1 == number => *last = number,
            _ => found.push([number, number]),
        }
    }
    let words = found.iter().map(|[first, last]| if first == last { first.to_string() } else { format!("{first} to {last}") });
    words.collect::<Vec<_>>().join(", ")
}
