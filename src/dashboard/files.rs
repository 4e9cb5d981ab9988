//! The files of the page, which are part of the program.

/// A file of the page.
#[derive(Debug, Clone, Copy)]
pub(super) struct File {
    /// Path in the folder `page`.
    path: &'static str,
    pub media_type: &'static str,
    pub bytes: &'static [u8],
}

macro_rules! file {
    ($path:literal, $type:expr) => {
        File { path: $path, media_type: $type, bytes: include_bytes!(concat!("page/", $path)) }
    };
}

const SCRIPT: &str = "text/javascript; charset=utf-8";
const STYLE: &str = "text/css; charset=utf-8";

pub(super) const PAGE: File = file!("index.html", "text/html; charset=utf-8");

const FILES: &[File] = &[
    file!("axes.js", SCRIPT),
    file!("camera.js", SCRIPT),
    file!("charts.js", SCRIPT),
    file!("colour_bar.js", SCRIPT),
    file!("connection.js", SCRIPT),
    file!("graticule.js", SCRIPT),
    file!("histogram.js", SCRIPT),
    file!("history.js", SCRIPT),
    file!("overlay.js", SCRIPT),
    file!("page.js", SCRIPT),
    file!("picture.js", SCRIPT),
    file!("plane.js", SCRIPT),
    file!("preferences.js", SCRIPT),
    file!("projection.js", SCRIPT),
    file!("protocol.js", SCRIPT),
    file!("steering.js", SCRIPT),
    file!("terms.js", SCRIPT),
    file!("values.js", SCRIPT),
    file!("warnings.js", SCRIPT),
    file!("words.js", SCRIPT),
    file!("icon.svg", "image/svg+xml; charset=utf-8"),
    file!("style.css", STYLE),
    file!("vendor/uPlot.esm.js", SCRIPT),
    file!("vendor/uPlot.min.css", STYLE),
];

/// The file whose path is the end of this one.
pub(super) fn named(path: &str) -> Option<File> {
    FILES.iter().copied().find(|file| path.strip_suffix(file.path).is_some_and(|before| before.ends_with('/')))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;
    use std::process::Command;

    /// Paths of the files in a folder, except notes, licences, and what says of which package they are.
    fn paths(folder: &Path, root: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let files = entries
            .flat_map(|path| if path.is_dir() { paths(&path, root) } else { vec![path.strip_prefix(root).unwrap().display().to_string()] });
        files.filter(|path| ![".md", ".LICENSE", ".json", "SUMS"].iter().any(|end| path.ends_with(end))).collect()
    }

    #[test]
    fn every_file_of_the_page_is_served_and_no_name_hides_another() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/dashboard/page");
        let mut found = paths(&root, &root);
        let mut served: Vec<_> = FILES.iter().chain([&PAGE]).map(|file| file.path.to_owned()).collect();
        found.sort();
        served.sort();
        assert_eq!(served, found);
        for file in FILES {
            assert_eq!(named(&format!("/node/host/8577/{}", file.path)).unwrap().path, file.path);
        }
        assert!(named("/nopage.js").is_none() && named("/../Cargo.toml").is_none());
    }

    #[test]
    fn files_of_other_packages_are_unchanged_and_of_the_locked_version() {
        let vendor = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/dashboard/page/vendor");
        let read = |name: &str| std::fs::read_to_string(vendor.join(name)).unwrap();
        let sums = read("SHA512SUMS");
        let mut named: Vec<_> = sums.lines().filter_map(|line| line.split_whitespace().last()).collect();
        named.sort_unstable();
        assert_eq!(named, ["uPlot.LICENSE", "uPlot.esm.js", "uPlot.min.css"]);
        let checked = Command::new("sha512sum").args(["--check", "--strict", "SHA512SUMS"]).current_dir(&vendor).output().unwrap();
        assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stdout));
        let lock: serde_json::Value = serde_json::from_str(&read("package-lock.json")).unwrap();
        let locked = &lock["packages"]["node_modules/uplot"];
        let version = locked["version"].as_str().unwrap();
        assert!(locked["integrity"].as_str().unwrap().starts_with("sha512-"), "{locked}");
        assert_eq!(lock["packages"][""]["dependencies"]["uplot"], version, "an exact version, not a range");
        assert!(read("uPlot.esm.js").contains(&format!("(v{version})")) && read("README.md").contains(&format!("| {version} |")));
    }
}
