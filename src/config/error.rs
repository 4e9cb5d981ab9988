//! Errors that point at the line.

use super::renamed::renamed;
use crate::setting::Refused;
use serde::{Deserialize, Deserializer};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why a scene is refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {message}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        message: String,
    },
    /// The file is no TOML, has an unknown key, or a value of the wrong type.
    #[error("{path}:{line}: {message}\n  {line:>4} | {excerpt}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// That line.
        excerpt: String,
        /// What is wrong with it.
        message: String,
    },
    /// A value is outside its range, or does not go with another one.
    #[error("{place}: `{key}` {found}; accepted: {accepted}{}", excerpt(.line))]
    Value {
        /// File and line, or `--set`.
        place: String,
        /// Dotted key.
        key: String,
        /// What was found, as in `is -1`.
        found: String,
        /// What is accepted.
        accepted: String,
        /// Line number and line, where the file has it.
        line: Option<(usize, String)>,
    },
    /// A `--set` that cannot be applied.
    #[error("--set {given}: {message}")]
    Override {
        /// As given.
        given: String,
        /// What is wrong with it.
        message: String,
    },
    /// The scene of a run cannot be written beside what it makes.
    #[error("the scene cannot be written as a file: {message}")]
    Unwritable {
        /// What is wrong with it.
        message: String,
    },
}

fn excerpt(line: &Option<(usize, String)>) -> String {
    line.as_ref().map_or_else(String::new, |(number, text)| format!("\n  {number:>4} | {text}"))
}

impl ConfigError {
    /// Finds the line of `text` that set the key, unless it was set at another place.
    pub(super) fn locate(refused: Refused, path: &Path, text: &str, elsewhere: Option<String>) -> Self {
        let Refused { key, found, accepted, .. } = refused;
        let line = if elsewhere.is_none() { span_of(text, &key).map(|at| line_at(text, at)) } else { None };
        let place = match (elsewhere, &line) {
            (Some(place), _) => place,
            (None, Some((number, _))) => format!("{}:{number}", path.display()),
            (None, None) => path.display().to_string(),
        };
        Self::Value { place, key, found, accepted, line }
    }

    /// Adds the file and the line.
    pub(super) fn from_toml(path: &Path, text: &str, error: &KeyError) -> Self {
        let (line, excerpt) = line_at(text, error.at.unwrap_or(0));
        Self::Syntax { path: path.to_path_buf(), line, excerpt, message: error.message.clone() }
    }
}

/// A fault of TOML text: which key, what was found, what is accepted.
#[derive(Debug)]
pub(super) struct KeyError {
    /// Byte offset. `None` if the value is not of a text.
    at: Option<usize>,
    pub(super) message: String,
}

impl KeyError {
    pub(super) fn syntax(error: &toml::de::Error) -> Self {
        Self { at: error.span().map(|span| span.start), message: error.message().to_owned() }
    }
}

/// Deserialises TOML.
///
/// # Errors
/// The dotted key at fault, in the words of a scene file.
pub(super) fn read<'de, T: Deserialize<'de>>(toml: impl Deserializer<'de, Error = toml::de::Error>) -> Result<T, KeyError> {
    serde_path_to_error::deserialize(toml).map_err(|error| {
        let path = error.path().to_string();
        KeyError { message: in_plain_words(&path, error.inner().message()), ..KeyError::syntax(error.inner()) }
    })
}

/// Byte offset of the value at a dotted key, or of the nearest table above it.
fn span_of(text: &str, key: &str) -> Option<usize> {
    let document = toml_edit::Document::parse(text).ok()?;
    let mut item = document.as_item();
    let mut best = None;
    for part in key.split('.') {
        let Some(next) = item.get(part) else { break };
        item = next;
        best = item.span().map(|s| s.start).or(best);
    }
    best
}

/// Line number (from 1) and text of the line that holds byte `at`.
fn line_at(text: &str, at: usize) -> (usize, String) {
    let at = at.min(text.len());
    let before = text.get(..at).unwrap_or("");
    let number = before.matches('\n').count();
    (number + 1, text.lines().nth(number).unwrap_or("").to_owned())
}

/// Translates serde's message on the key at `path` (`.` is the file) into the words of a scene file, with the nearest accepted name if one is
/// unknown.
fn in_plain_words(path: &str, message: &str) -> String {
    if let Some(field) = message.strip_prefix("missing field `") {
        let table = if path == "." { String::new() } else { format!("{path}.") };
        return format!("`{table}{field} is missing");
    }
    if message.starts_with("unknown field")
        && let Some(new) = renamed(path)
    {
        return format!("`{path}` has a new name; accepted: `{new}`");
    }
    let wrong = ["invalid type: ", "invalid value: ", "invalid length "].into_iter().find_map(|start| message.strip_prefix(start));
    match wrong.and_then(|rest| rest.split_once(", expected ")) {
        Some((found, expected)) => format!("`{path}` is {}; accepted: {}", found_in_words(found), expected_in_words(expected)),
        None => format!("`{path}`: {}", with_suggestion(message)),
    }
}

/// ``integer `5` `` as `5`.
fn found_in_words(found: &str) -> String {
    let value = found.split_once('`').and_then(|(_, rest)| rest.rsplit_once('`')).map(|(value, _)| value);
    match (found, value, found.strip_prefix("string ")) {
        (_, Some(value), _) => value.to_owned(),
        (_, _, Some(text)) => text.to_owned(),
        ("sequence", ..) => "a list".to_owned(),
        ("map", ..) => "a table".to_owned(),
        _ if found.bytes().all(|b| b.is_ascii_digit()) => format!("a list of {found}"),
        _ => found.to_owned(),
    }
}

/// `usize` as `a whole number, 0 or above`.
fn expected_in_words(expected: &str) -> String {
    match expected {
        "usize" | "u64" | "u32" | "u16" | "u8" => "a whole number, 0 or above".to_owned(),
        "isize" | "i64" | "i32" => "a whole number".to_owned(),
        "f64" | "f32" => "a number".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "a string" | "path string" => "a text in quotation marks".to_owned(),
        "a sequence" => "a list".to_owned(),
        _ if expected.starts_with("struct ") => "a table".to_owned(),
        _ => match expected.strip_prefix("an array of length ") {
            Some(length) => format!("a list of {length}"),
            None => expected.to_owned(),
        },
    }
}

/// Adds the nearest accepted name to serde's message on an unknown field or variant.
fn with_suggestion(message: &str) -> String {
    let mut quoted = message.split('`').skip(1).step_by(2);
    let Some(unknown) = quoted.next().filter(|_| message.starts_with("unknown")) else { return message.to_owned() };
    // A name that holds the other, as `tol` and `tolerance`, is nearer than its length says.
    let contained = |known: &str| unknown.len().min(known.len()) >= 3 && (known.contains(unknown) || unknown.contains(known));
    let nearest = quoted
        .map(|known| (strsim::damerau_levenshtein(unknown, known), known))
        .min_by_key(|&(distance, known)| (distance > 2 && !contained(known), distance));
    match nearest {
        Some((distance, known)) if distance <= unknown.len().max(3) / 2 || contained(known) => {
            format!("{message}. Did you mean `{known}`?")
        }
        _ => message.to_owned(),
    }
}
