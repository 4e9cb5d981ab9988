//! `docs/maps.md`: the fields of the record and the options of the command.

use super::page;
use std::path::Path;

/// Names of fields of a struct in a source file.
fn fields(source: &str, name: &str) -> Vec<String> {
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(source)).unwrap();
    let body = text.split_once(&format!("struct {name} {{")).unwrap().1.split_once("\n}").unwrap().0;
    let lines = body.lines().map(str::trim).filter(|line| !line.starts_with("//") && !line.starts_with('#'));
    let names = lines.filter_map(|line| line.trim_start_matches("pub ").split_once(": ").map(|(name, _)| name.to_owned()));
    names.filter(|name| name.chars().all(|c| c.is_ascii_lowercase() || c == '_')).collect()
}

#[test]
fn every_field_of_the_record_has_its_row() {
    let page = page("maps.md");
    let rows: String = page.lines().filter(|line| line.starts_with("| `")).collect();
    for name in ["MapRecord", "RidgeRecord", "PanelRecord"] {
        let fields = fields("src/map/record.rs", name);
        // That of ridges has two.
        assert!(fields.len() >= 2, "{name}: {fields:?}");
        for field in fields {
            assert!(rows.contains(&format!("`{field}`")), "{name}: docs/maps.md has no `{field}`");
        }
    }
}

#[test]
fn every_option_is_on_the_page() {
    let page = page("maps.md");
    let commands = ["map", "ridges", "figure"];
    for option in commands.iter().flat_map(|command| fields(&format!("src/cli/{command}.rs"), "Options")) {
        let option = option.replace('_', "-");
        assert!(
            ["paths", "run", "out"].contains(&option.as_str()) || page.contains(&format!("--{option}")),
            "docs/maps.md has no --{option}"
        );
    }
    for kind in ["polar", "plate_carree", "lambert", "mercator", "plain"] {
        assert!(page.contains(&format!("| `{kind}`")), "docs/maps.md has no {kind}");
    }
}
