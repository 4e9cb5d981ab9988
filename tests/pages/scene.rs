//! The page of all keys of a scene file, compared with the keys that are read.

use ridgewatch::config::{RENAMED, SceneFile};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// Every table, with only those keys that have no default.
const MINIMAL: &str = "
    [source]
    kind = \"archive\"
    [domain]
    min = [0, 0, 0]
    max = [1, 1, 1]
    [archive.synthetic]
    shape = \"flame\"
    [camera]
    eye = [0, 0, 1]
    look_at = [0, 0, 0]
    up = [0, 1, 0]
    [light]
    radiance = [1, 1, 1]
    [transfer]
";

/// Dotted keys with their values.
fn leaves(value: &Value, prefix: &str, found: &mut BTreeMap<String, Value>) {
    for (key, value) in value.as_object().unwrap() {
        let key = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        if value.is_object() { leaves(value, &key, found) } else { drop(found.insert(key, value.clone())) }
    }
}

fn back_quoted(cell: &str) -> Option<&str> {
    cell.split('`').nth(1)
}

/// The page up to its table of renamed keys, and that table.
fn text() -> (String, String) {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/scene.md")).unwrap();
    let (keys, renamed) = text.split_once("\n## Renamed keys\n").unwrap();
    (keys.to_owned(), renamed.to_owned())
}

/// Dotted keys of the page's tables with the cell of their default.
fn documented() -> BTreeMap<String, String> {
    let (mut table, mut found) = (String::new(), BTreeMap::new());
    for line in text().0.lines() {
        if line.starts_with('#') {
            table = back_quoted(line).unwrap_or_default().trim_matches(['[', ']']).to_owned();
        } else if line.starts_with("| `") {
            let cells: Vec<&str> = line.split('|').map(str::trim).collect();
            // Opening and closing bars make two empty cells more.
            assert_eq!(cells.len(), 7, "five columns: {line}");
            let key = back_quoted(cells[1]).unwrap();
            let key = if table.is_empty() { key.to_owned() } else { format!("{table}.{key}") };
            assert!(found.insert(key, cells[2].to_owned()).is_none(), "twice: {line}");
        }
    }
    found
}

#[test]
fn the_page_names_every_renamed_key() {
    let table = text().1;
    let rows: Vec<(&str, &str)> = table
        .lines()
        .filter(|line| line.starts_with("| `"))
        .map(|line| line.split('|').collect())
        .map(|cells: Vec<&str>| (back_quoted(cells[1]).unwrap(), back_quoted(cells[2]).unwrap()))
        .collect();
    assert_eq!(rows, RENAMED);
}

#[test]
fn the_page_names_every_key_with_its_default_and_no_other() {
    let scene: SceneFile = toml::from_str(MINIMAL).unwrap();
    let mut read = BTreeMap::new();
    leaves(&serde_json::to_value(&scene).unwrap(), "", &mut read);
    let page = documented();
    assert_eq!(page.keys().collect::<BTreeSet<_>>(), read.keys().collect::<BTreeSet<_>>());
    let minimal: toml::Table = MINIMAL.parse().unwrap();
    for (key, cell) in &page {
        let parts: Vec<&str> = key.split('.').collect();
        let required = parts.iter().try_fold(&toml::Value::Table(minimal.clone()), |value, part| value.get(part)).is_some();
        let Some(default) = back_quoted(cell) else {
            assert_eq!(cell == "required", required, "{key}: {cell}");
            assert!(required || (cell == "none" && read[key].is_null()), "{key}: the page says {cell}, it is {}", read[key]);
            continue;
        };
        // Setting a key to its default changes nothing.
        let mut set = minimal.clone();
        let mut table = &mut set;
        for part in &parts[..parts.len() - 1] {
            table = table.entry(*part).or_insert_with(|| toml::Value::Table(toml::Table::new())).as_table_mut().unwrap();
        }
        let value: toml::Table = format!("value = {default}").parse().unwrap();
        table.insert(parts[parts.len() - 1].to_owned(), value["value"].clone());
        let again: SceneFile = set.try_into().unwrap();
        assert!(again == scene && !read[key].is_null(), "{key}: the page says {default}, it is {}", read[key]);
    }
}
