//! Where each key of a scene was set, so that an error points at it.

use super::error::{ConfigError, KeyFault};
use crate::setting::Refused;
use std::path::{Path, PathBuf};

/// The scene file and the options that changed it.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Origin {
    path: PathBuf,
    text: String,
    /// Keys set by options, each with the option to name in errors, oldest first.
    options: Vec<(String, String)>,
}

impl Origin {
    pub(super) fn new(path: &Path, text: &str, overrides: &[String]) -> Self {
        let key = |given: &String| given.split('=').next().unwrap_or_default().trim().to_owned();
        let options = overrides.iter().map(|given| (key(given), format!("--set {given}"))).collect();
        Self { path: path.to_path_buf(), text: text.to_owned(), options }
    }

    pub(super) fn set_by(&mut self, key: &str, option: String) {
        self.options.push((key.to_owned(), option));
    }

    /// Keys set by options.
    pub(super) fn options(&self) -> impl Iterator<Item = &str> {
        self.options.iter().map(|(key, _)| key.as_str())
    }

    /// Whether an option sets the key.
    pub(super) fn sets(&self, key: &str) -> bool {
        self.options().any(|set| set == key)
    }

    /// Locates text that is not TOML.
    pub(super) fn syntax_error(&self, error: &toml::de::Error) -> ConfigError {
        self.of_file(KeyFault { at: error.span().map(|span| span.start), message: error.message().to_owned() })
    }

    /// Locates a fault of the file.
    pub(super) fn of_file(&self, fault: KeyFault) -> ConfigError {
        self.at_line(fault.message, Some(self.line_at(fault.at.unwrap_or(0))))
    }

    /// Locates a value that is not accepted.
    pub(super) fn locate(&self, refused: Refused) -> ConfigError {
        let message = refused.to_string();
        // Of several keys at fault together, the user has just set the last one of the command line.
        let at_fault = |set: &str| {
            let mut keys = std::iter::once(&refused.key).chain(&refused.beside);
            keys.any(|key| key.strip_prefix(set).is_some_and(|rest| rest.is_empty() || rest.starts_with('.')))
        };
        // A URL may hold a secret: the message shows what may be shown, and its line or option nothing more.
        let hidden = refused.key == "archive.files" && refused.found.contains("://");
        match self.options.iter().rev().find(|(key, _)| at_fault(key)) {
            Some((key, _)) if hidden => ConfigError::Fault { place: format!("--set {key}"), message, line: None },
            None if hidden => {
                let number = self.offset_of(&refused.key).map_or_else(String::new, |at| format!(":{}", self.line_at(at).0));
                ConfigError::Fault { place: format!("{}{number}", self.path.display()), message, line: None }
            }
            Some((_, option)) => ConfigError::Fault { place: option.clone(), message, line: None },
            None => self.at_line(message, self.offset_of(&refused.key).map(|at| self.line_at(at))),
        }
    }

    fn at_line(&self, message: String, line: Option<(usize, String)>) -> ConfigError {
        let path = self.path.display();
        ConfigError::Fault {
            place: line.as_ref().map_or_else(|| path.to_string(), |(number, _)| format!("{path}:{number}")),
            message,
            line,
        }
    }

    /// Byte offset of the value at a dotted key, or of the nearest table above it.
    fn offset_of(&self, key: &str) -> Option<usize> {
        let document = toml_edit::Document::parse(self.text.as_str()).ok()?;
        let items = key.split('.').scan(document.as_item(), |item, part| {
            *item = item.get(part)?;
            Some(*item)
        });
        items.filter_map(|item| Some(item.span()?.start)).last()
    }

    /// Number (from 1) and text of the line that holds byte `at`.
    fn line_at(&self, at: usize) -> (usize, String) {
        let number = self.text.bytes().take(at).filter(|byte| *byte == b'\n').count();
        (number + 1, self.text.lines().nth(number).unwrap_or("").to_owned())
    }
}
