//! `ridgewatch compare`.

use super::common::{Common, Usage, print_json, print_text, refuse_settings};
use anyhow::Result;
use std::path::PathBuf;

/// Options of `compare`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Picture.
    a: PathBuf,
    /// Reference picture.
    b: PathBuf,
    /// Tone map applied before PSNR and SSIM: contrast, brightness, gamma.
    #[arg(long, num_args = 3, value_names = ["CONTRAST", "BRIGHTNESS", "GAMMA"], default_values_t = [1.85, 0.75, 1.4])]
    tone_map: Vec<f64>,
}

/// Compares.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    refuse_settings(common, "compare", "A, B, --tone-map")?;
    let tone_map = [options.tone_map[0], options.tone_map[1], options.tone_map[2]];
    let [contrast, brightness, gamma] = tone_map;
    if !(contrast.is_finite() && brightness.is_finite() && gamma.is_finite() && gamma > 0.0) {
        let accepted = "three finite numbers, the last above 0";
        return Err(Usage(format!("--tone-map {contrast} {brightness} {gamma} is not accepted; accepted: {accepted}")).into());
    }
    let comparison = ridgewatch::publish::compare_files(&options.a, &options.b, tone_map)?;
    if common.json {
        return print_json(&comparison);
    }
    print_text(comparison);
    Ok(())
}
