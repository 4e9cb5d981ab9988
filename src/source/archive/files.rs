//! Files, folders and patterns as a list of files. A Zarr store is a folder that counts as one file.

use crate::error::SourceError;
use crate::formats::{FormatFault, checked_url, is_store, is_url};
use std::path::{Path, PathBuf};

/// Extensions of the files that are taken from a folder.
const EXTENSIONS: [&str; 12] = ["nc", "nc4", "cdf", "netcdf", "h5", "hdf5", "hdf", "grib", "grib1", "grib2", "grb", "grb2"];

/// Expands folders and patterns, in name order. A file that is named twice counts once. URLs of stores stay as they are.
///
/// # Errors
/// No paths; a folder or pattern without files, or that cannot be read; a URL that is not accepted.
pub fn expand(paths: &[PathBuf]) -> Result<Vec<PathBuf>, SourceError> {
    if paths.is_empty() {
        return Err(SourceError::NoFiles);
    }
    let mut files: Vec<PathBuf> = Vec::new();
    for path in paths {
        let text = path.to_string_lossy();
        if is_url(path) {
            let url = checked_url(&text).map_err(|(shown, what)| SourceError::file(Path::new(&shown), what))?;
            files.push(url.into());
            continue;
        }
        refuse_dangling(path)?;
        if is_called_store(path) {
            files.push(path.clone());
        } else if path.is_dir() {
            files.extend(folder(path)?);
        } else if !path.exists() && text.contains(['*', '?', '[']) {
            files.extend(pattern(&text)?);
        } else {
            files.push(path.clone());
        }
    }
    let mut seen = std::collections::HashSet::new();
    files.retain(|f| seen.insert(f.canonicalize().unwrap_or_else(|_| f.clone())));
    Ok(files)
}

fn unreadable(path: &Path, cause: impl ToString) -> SourceError {
    FormatFault::Open(cause.to_string()).of(path).into()
}

/// Refuses a link whose target does not exist: a time would be missing without a word.
fn refuse_dangling(path: &Path) -> Result<(), SourceError> {
    match std::fs::read_link(path) {
        Ok(target) if !path.exists() => {
            let what =
                format!("it is a link to {}, which does not exist: fetch or restore that file, or remove the link", target.display());
            Err(SourceError::file(path, what))
        }
        _ => Ok(()),
    }
}

/// Whether a folder is a store, or is called one: a copy without its metadata would be left out without a word.
fn is_called_store(path: &Path) -> bool {
    is_store(path) || (path.is_dir() && path.extension().is_some_and(|extension| extension == "zarr"))
}

fn folder(path: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let failed = |cause| unreadable(path, cause);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(failed)? {
        let file = entry.map_err(failed)?.path();
        let extension = file.extension().and_then(|e| e.to_str()).unwrap_or_default();
        let name = file.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        // A store may have any name; a link to one that is gone shows by its ending alone.
        let named = EXTENSIONS.iter().any(|e| e.eq_ignore_ascii_case(extension))
            || name.starts_with("wrfout_")
            || [".zarr", ".zarr.zip"].iter().any(|ending| name.ends_with(ending));
        if named {
            refuse_dangling(&file)?;
        }
        if (file.is_file() && named) || is_called_store(&file) {
            files.push(file);
        }
    }
    if files.is_empty() {
        return Err(SourceError::NoMatch { pattern: path.join("*.nc, *.h5, *.grib, *.zarr").display().to_string() });
    }
    files.sort();
    Ok(files)
}

fn pattern(text: &str) -> Result<Vec<PathBuf>, SourceError> {
    let found = glob::glob(text).map_err(|e| SourceError::NoMatch { pattern: format!("{text} ({e})") })?;
    let mut files = Vec::new();
    for file in found {
        let file = file.map_err(|e| unreadable(e.path(), e.error()))?;
        refuse_dangling(&file)?;
        if file.is_file() || is_called_store(&file) {
            files.push(file);
        }
    }
    if files.is_empty() {
        return Err(SourceError::NoMatch { pattern: text.into() });
    }
    Ok(files)
}
