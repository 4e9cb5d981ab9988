//! `docs/security.md`: its limits are those of the code, and what it links to exists.

use super::page;
use std::path::Path;

/// Text of a file of the project.
fn source(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

#[test]
fn the_limits_are_those_of_the_code() {
    let page = page("security.md");
    let rows: Vec<&str> = page.lines().filter(|line| line.contains("` in `")).collect();
    assert!(rows.len() >= 20, "the table is found");
    for row in rows {
        let cell = row.split('|').nth(3).unwrap().trim().trim_matches('`');
        let (value, path) = cell.split_once("` in `").unwrap();
        let text = source(path);
        let holds = |end: &str| text.contains(&format!("{value}{end}"));
        assert!([",", ";", " }"].into_iter().any(holds), "{path} has no {value}");
    }
}

#[test]
fn the_links_lead_to_headings() {
    // As GitHub makes anchors of headings.
    let anchor = |heading: &str| -> String {
        let kept = heading.chars().filter(|c| c.is_alphanumeric() || *c == ' ' || *c == '-');
        kept.collect::<String>().to_lowercase().replace(' ', "-")
    };
    let page = page("security.md");
    let links: Vec<&str> = page.split("](").skip(1).map(|rest| rest.split(')').next().unwrap()).collect();
    assert!(links.len() > 10);
    for link in links {
        let (file, wanted) = link.split_once('#').unwrap_or((link, ""));
        let text = source(&format!("docs/{file}"));
        let mut headings = text.lines().filter(|line| line.starts_with('#')).map(|line| anchor(line.trim_start_matches('#').trim()));
        assert!(wanted.is_empty() || headings.any(|heading| heading == wanted), "{link}");
    }
}
