//! What reading a file may cost, and whether it may lead to other files.

use ridgewatch_base::memory::{available, gib};
use serde::{Deserialize, Serialize};

/// Groups within groups, more than any archive has.
pub const MAX_DEPTH: usize = 64;
/// Groups, variables and dimensions of a file.
pub const MAX_OBJECTS: usize = 10_000;
/// Attributes of a file and of all that it holds.
pub const MAX_ATTRIBUTES: usize = 100_000;
/// Bytes of all these attributes.
pub const MAX_ATTRIBUTE_BYTES: u64 = 16 << 20;

/// Limits of one archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Limits {
    /// Bytes that reading may need.
    pub memory: u64,
    /// Whether values may lie in other files.
    pub external: bool,
}

impl Limits {
    /// No limit of memory, and no other files.
    #[cfg(test)]
    pub const NONE: Self = Self { memory: u64::MAX, external: false };

    /// Limits with this memory in GiB, by default nine tenths of what is free.
    pub fn new(memory_gib: Option<f64>, external: bool) -> Self {
        let free = || available().map_or(u64::MAX, |bytes| bytes / 10 * 9);
        Self { memory: memory_gib.map_or_else(free, |gib| (gib * f64::from(1 << 30)) as u64), external }
    }

    /// Checks what is needed for `what`, such as `4096 nodes`.
    ///
    /// # Errors
    /// It exceeds the memory that reading may need.
    pub fn check(&self, bytes: u64, what: &str) -> Result<(), String> {
        if bytes <= self.memory {
            return Ok(());
        }
        let (needed, accepted) = (gib(bytes), gib(self.memory));
        Err(format!(
            "{what} need {needed:.2} GiB of memory; accepted are {accepted:.2} GiB: more with `archive.memory_gib`, less with a part of the \
             archive (`archive.region`, `archive.level`)"
        ))
    }

    /// Checks the reading of `total` values of a variable whose chunks unpack to `chunk` bytes each.
    ///
    /// # Errors
    /// It exceeds the memory that reading may need.
    pub fn check_read(&self, total: usize, chunk: u64) -> Result<(), String> {
        // A chunk is read whole, and filters hold it twice. Values are held twice: by the library and by us.
        self.check(chunk.saturating_mul(2), &format!("its chunks of {chunk} bytes"))?;
        self.check((total as u64).saturating_mul(2 * size_of::<f64>() as u64), &format!("{total} values"))
    }
}
