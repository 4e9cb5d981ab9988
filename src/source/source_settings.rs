//! `[source]` and `[domain]` of a scene file: kind of velocity, and the box of a closed form.

use super::archive_settings::ArchiveSettings;
use super::formats::{ACCEPTED_URLS, checked_url, is_url};
use ridgewatch_base::setting::{Refused, count, require, shown};
use serde::{Deserialize, Serialize};

/// Origin of the velocity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceKind {
    /// Double gyre.
    DoubleGyre,
    /// Arnold-Beltrami-Childress flow.
    Abc,
    /// Linear saddle.
    Saddle,
    /// Solid rotation.
    Rotation,
    /// Plane shear.
    Shear,
    /// The standard synthetic turbulence, sampled on a grid.
    Turbulence,
    /// NetCDF and HDF5 files, and Zarr stores (`[archive]`).
    Archive,
    /// A running simulation (`[live]`), with `ridgewatch attach`.
    Live,
}

/// `[source]`. Parameters that the kind does not have are refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceSettings {
    /// Kind.
    pub kind: SourceKind,
    /// Double gyre: A (0.1). Turbulence: root mean square of |v|, cells per snapshot at 192 cells along the short side (3).
    pub amplitude: Option<f64>,
    /// Double gyre: eps (0.25).
    pub epsilon: Option<f64>,
    /// Double gyre (2 pi / 10) and rotation (1): radians per time unit.
    pub omega: Option<f64>,
    /// Saddle and shear: rate (1).
    pub rate: Option<f64>,
    /// ABC: A (sqrt 3).
    pub a: Option<f64>,
    /// ABC: B (sqrt 2).
    pub b: Option<f64>,
    /// ABC: C (1).
    pub c: Option<f64>,
    /// ABC: growth of A in time (0; Haller's unsteady flow has 0.5).
    pub growth: Option<f64>,
    /// Turbulence: nodes along x, y and z (96, 48, 48).
    pub nodes: Option<[usize; 3]>,
    /// Turbulence: number of modes (48).
    pub modes: Option<usize>,
    /// Turbulence: largest wave number in cycles per short side (14).
    pub k_max: Option<f64>,
    /// Turbulence: number of snapshots (12).
    pub snapshots: Option<usize>,
}

/// `[domain]`: the box of a closed form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DomainSettings {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
}

impl SourceSettings {
    /// Checks ranges, and that a closed form has its box (`domain`) and an archive its files (or settings to synthesize them).
    ///
    /// # Errors
    /// The setting at fault.
    pub fn check(&self, domain: Option<&DomainSettings>, archive: &ArchiveSettings) -> Result<(), Refused> {
        let source = self;
        let kind = source.kind;
        use SourceKind::*;
        let given = [
            ("amplitude", source.amplitude, &[DoubleGyre, Turbulence][..]),
            ("epsilon", source.epsilon, &[DoubleGyre]),
            ("omega", source.omega, &[DoubleGyre, Rotation]),
            ("rate", source.rate, &[Saddle, Shear]),
            ("a", source.a, &[Abc]),
            ("b", source.b, &[Abc]),
            ("c", source.c, &[Abc]),
            ("growth", source.growth, &[Abc]),
            ("k_max", source.k_max, &[Turbulence]),
            ("nodes", source.nodes.map(|n| n[0] as f64), &[Turbulence]),
            ("modes", source.modes.map(|n| n as f64), &[Turbulence]),
            ("snapshots", source.snapshots.map(|n| n as f64), &[Turbulence]),
        ];
        for (key, value, kinds) in given {
            let Some(value) = value else { continue };
            let key = format!("source.{key}");
            if !kinds.contains(&kind) {
                return fault(
                    &key,
                    format!("does not belong to kind {}", shown(kind)),
                    &format!("only with kind {}", kinds.iter().map(shown).collect::<Vec<_>>().join(" or ")),
                );
            }
            require(value.is_finite(), &key, value, "a finite number")?;
        }
        if let Some(nodes) = source.nodes {
            for n in nodes {
                count("source.nodes", n, 4, 4096)?;
            }
            count("source.nodes", nodes.iter().product(), 64, 1 << 28)?;
        }
        if let Some(n) = source.modes {
            count("source.modes", n, 1, 4096)?;
        }
        if let Some(n) = source.snapshots {
            count("source.snapshots", n, 2, 100_000)?;
        }
        if let Some(k) = source.k_max {
            require(k > 2.0, "source.k_max", k, "a number above 2, the smallest wave number")?;
        }
        match (kind, domain) {
            (Archive | Turbulence | Live, Some(_)) => fault(
                "domain",
                "is given for gridded velocity",
                "no [domain]: the grid is the domain (archives may be cropped with archive.region)",
            )?,
            (DoubleGyre | Abc | Saddle | Rotation | Shear, None) => {
                fault("domain", "is missing", "[domain] with min = [x, y, z] and max = [x, y, z], since a closed form has no grid")?
            }
            _ => {}
        }
        if let Some(domain) = domain {
            let proper = (0..3).all(|k| domain.min[k].is_finite() && domain.max[k].is_finite() && domain.max[k] > domain.min[k]);
            let accepted = format!("three finite numbers above domain.min = {:?}", domain.min);
            require(proper, "domain.max", domain.max, &accepted).map_err(|refused| refused.beside(&["domain.min"]))?;
        }
        if kind == Archive && archive.files.is_empty() && archive.synthetic.is_none() {
            fault("archive.files", "is empty", "a list of files or globs, or a table [archive.synthetic]")?;
        }
        // Before a scene is written anywhere: a URL may hold a secret.
        for url in archive.files.iter().filter(|path| is_url(path)) {
            if let Err((shown, what)) = checked_url(&url.to_string_lossy()) {
                fault("archive.files", format!("holds {shown}: {what}"), ACCEPTED_URLS)?;
            }
        }
        Ok(())
    }
}

fn fault(key: &str, found: impl std::fmt::Display, accepted: &str) -> Result<(), Refused> {
    Err(Refused::new(key, found, accepted))
}
