//! The secret that a browser must know.

use super::error::DashboardError;
use std::fmt;
use std::fs::OpenOptions;
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;
use subtle::ConstantTimeEq;

/// Length of a random token, in bytes; twice as many digits.
const RANDOM_BYTES: usize = 32;
/// Accepted lengths of a token in a file, in characters.
const LENGTHS: std::ops::RangeInclusive<usize> = 32..=256;

/// A secret of letters, digits, `-` and `_`. Its value is not in its `Debug` form.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

impl Token {
    /// 256 random bits from the system.
    ///
    /// # Errors
    /// The system has none.
    pub fn random() -> io::Result<Self> {
        let mut bytes = [0; RANDOM_BYTES];
        getrandom::fill(&mut bytes).map_err(io::Error::other)?;
        Ok(Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    /// The token in a file that only this user reads; a file that does not exist is made, with a random one.
    ///
    /// # Errors
    /// A file that others may read or that holds something else, or an error of the system.
    pub fn in_file(path: &Path) -> Result<Self, DashboardError> {
        let fault = |problem: String| DashboardError::TokenFile { path: path.to_owned(), problem };
        let failed = |error: io::Error| fault(error.to_string());
        match OpenOptions::new().write(true).create_new(true).mode(0o600).open(path) {
            Ok(mut file) => {
                let token = Self::random().map_err(failed)?;
                writeln!(file, "{}", token.0).map_err(failed)?;
                return Ok(token);
            }
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(failed(error)),
        }
        // A pipe would be waited for.
        let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path).map_err(failed)?;
        let about = file.metadata().map_err(failed)?;
        if !about.is_file() || about.mode() & 0o077 != 0 {
            return Err(fault(format!(
                "has mode {:04o}; accepted: a file that only its owner may read (chmod 600)",
                about.mode() & 0o7777
            )));
        }
        let mut text = String::new();
        file.take(*LENGTHS.end() as u64 + 2).read_to_string(&mut text).map_err(failed)?;
        let text = text.trim();
        if !LENGTHS.contains(&text.len()) || !text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte)) {
            return Err(fault("accepted: one line of 32 to 256 letters, digits, - and _".to_owned()));
        }
        Ok(Self(text.to_owned()))
    }

    /// The token that only watches. It follows from this one, and this one does not follow from it.
    pub fn watching(&self) -> Self {
        let bytes = blake3::derive_key("ridgewatch 2026-11 dashboard: token that only watches", self.0.as_bytes());
        Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Compares in a time that does not depend on where the two differ.
    pub(super) fn is(&self, given: &str) -> bool {
        self.0.as_bytes().ct_eq(given.as_bytes()).into()
    }

    /// The value, for the address that the user opens.
    pub fn secret(&self) -> &str {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_random_token_is_itself_alone_and_not_printed() {
        let (a, b) = (Token::random().unwrap(), Token::random().unwrap());
        assert_eq!(a.secret().len(), 2 * RANDOM_BYTES);
        assert!(a.is(a.secret()) && !a.is(b.secret()) && !a.is("") && !a.is(&a.secret()[1..]));
        assert!(!format!("{a:?}").contains(a.secret()));
        let watching = a.watching();
        assert!(watching == a.watching() && !a.is(watching.secret()) && watching != b.watching() && watching.secret().len() == 64);
    }

    #[test]
    fn a_file_is_made_for_its_owner_and_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let token = Token::in_file(&path).unwrap();
        assert_eq!(path.metadata().unwrap().mode() & 0o777, 0o600);
        assert_eq!(Token::in_file(&path).unwrap(), token);
        std::fs::set_permissions(&path, Permissions::from_mode(0o640)).unwrap();
        assert!(Token::in_file(&path).unwrap_err().to_string().contains("0640"));
        std::fs::set_permissions(&path, Permissions::from_mode(0o600)).unwrap();
        for odd in ["", "short", &"a b".repeat(20), &"a".repeat(257)] {
            std::fs::write(&path, odd).unwrap();
            assert!(Token::in_file(&path).unwrap_err().to_string().contains("32 to 256"), "{odd:?}");
        }
    }
}
