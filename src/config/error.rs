//! Why a scene is refused, in the words of a scene file.

use super::renamed::renamed;
use serde::{Deserialize, Deserializer};
use std::path::PathBuf;
use thiserror::Error;

/// Why a scene is refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {message}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Error of the system.
        message: String,
    },
    /// The text is not TOML, a key is unknown, or a value is not accepted.
    #[error("{place}: {message}{}", excerpt(.line))]
    Fault {
        /// File and line, or option of the command line.
        place: String,
        /// The key, the value found, and the accepted values.
        message: String,
        /// Line number (from 1) and text of the line, if the file has it.
        line: Option<(usize, String)>,
    },
    /// The scene of a run cannot be written as a file.
    #[error("the scene cannot be written as a file: {message}")]
    Unwritable {
        /// Key and reason.
        message: String,
    },
}

fn excerpt(line: &Option<(usize, String)>) -> String {
    line.as_ref().map_or_else(String::new, |(number, text)| format!("\n  {number:>4} | {text}"))
}

/// A key or value that does not fit the settings.
#[derive(Debug)]
pub(super) struct KeyFault {
    /// Byte offset in the text. `None` if the value comes from an option.
    pub(super) at: Option<usize>,
    /// The key, the value found, and the accepted values.
    pub(super) message: String,
}

/// Deserialises TOML.
///
/// # Errors
/// The first fault, with its dotted key.
pub(super) fn read<'de, T: Deserialize<'de>>(toml: impl Deserializer<'de, Error = toml::de::Error>) -> Result<T, KeyFault> {
    serde_path_to_error::deserialize(toml).map_err(|error| KeyFault {
        at: error.inner().span().map(|span| span.start),
        message: in_plain_words(&error.path().to_string(), error.inner().message()),
    })
}

/// Translates serde's message on the key at `path` (`.` is the file) into the words of a scene file, with the nearest accepted name if one is
/// unknown.
fn in_plain_words(path: &str, message: &str) -> String {
    if let Some(field) = message.strip_prefix("missing field `") {
        let table = if path == "." { String::new() } else { format!("{path}.") };
        return format!("`{table}{field} is missing");
    }
    if let Some(rest) = message.strip_prefix("unknown field `") {
        return match renamed(path) {
            Some(new) => format!("`{path}` has a new name; accepted: `{new}`"),
            None => format!("`{path}` is unknown; {}", accepted_names(rest)),
        };
    }
    if let Some(rest) = message.strip_prefix("unknown variant `") {
        return format!("`{path}` is \"{}\"; {}", rest.split('`').next().unwrap_or_default(), accepted_names(rest));
    }
    let wrong = ["invalid type: ", "invalid value: ", "invalid length "].into_iter().find_map(|start| message.strip_prefix(start));
    match wrong.and_then(|rest| rest.split_once(", expected ")) {
        Some((found, expected)) => format!("`{path}` is {}; accepted: {}", found_in_words(found), expected_in_words(expected)),
        None => format!("`{path}`: {message}"),
    }
}

/// Writes ``integer `5` `` as `5`.
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

/// Writes `usize` as `a whole number, 0 or above`.
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

/// Rewrites ``found`, expected one of `known`, `other``` with the accepted name that is nearest to the one found.
fn accepted_names(message: &str) -> String {
    // The name found, then words and accepted names in turn.
    let mut pieces = message.split('`').step_by(2);
    let unknown = pieces.next().unwrap_or_default();
    let expected = message.split_once(", expected ").map_or("none", |(_, expected)| expected.strip_prefix("one of ").unwrap_or(expected));
    // A name that contains the other, as `tolerance` contains `tol`, is nearer than its length says.
    let contained = |known: &str| unknown.len().min(known.len()) >= 3 && (known.contains(unknown) || unknown.contains(known));
    let nearest = pieces
        .map(|known| (strsim::damerau_levenshtein(unknown, known), known))
        .min_by_key(|&(distance, known)| (distance > 2 && !contained(known), distance));
    match nearest.filter(|&(distance, known)| distance <= unknown.len().max(3) / 2 || contained(known)) {
        Some((_, known)) => format!("accepted: {expected}. Did you mean `{known}`?"),
        None => format!("accepted: {expected}"),
    }
}
