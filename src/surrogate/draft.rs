//! A checkpoint that is not written yet: what a surrogate was at one moment. Any thread may write it while the surrogate goes on learning.

use super::checkpoint::Checkpoint;
use super::trainer::NetworkDraft;
use super::{CheckpointError, Table};
use std::path::Path;

/// Weights, optimizer state and base table as they were. Numbers are shared with the surrogate until that changes them; those that a device
/// has copied come back when they are written.
pub struct Draft {
    kind: &'static str,
    notes: Vec<(&'static str, String)>,
    table: Option<Table>,
    network: Option<NetworkDraft>,
    not_behind: Option<String>,
}

impl Draft {
    /// Of a surrogate of this kind.
    pub(super) fn new(kind: &'static str, table: Option<Table>, network: Option<NetworkDraft>) -> Self {
        Self { kind, notes: Vec::new(), table, network, not_behind: None }
    }

    /// States something as text.
    pub(super) fn noting(mut self, key: &'static str, text: String) -> Self {
        self.notes.push((key, text));
        self
    }

    /// It had to be waited for, for this reason.
    pub(super) fn waited_for(mut self, why: Option<String>) -> Self {
        self.not_behind = why;
        self
    }

    /// Why [`super::Surrogate::draft_behind`] could not be done behind the loop's back; none: it was.
    pub fn not_behind(&self) -> Option<&str> {
        self.not_behind.as_deref()
    }

    /// Writes the file, and gives its size in bytes. It appears under its name when it is whole; until then, and after an error, what was there
    /// before stays.
    ///
    /// # Errors
    /// What the system says, and a device that was lost before its copy had come back.
    pub fn write(mut self, path: &Path) -> Result<u64, CheckpointError> {
        // First, since the next slide wants the memory of what a device holds, and the network and the disk take their time.
        if let Some(table) = &mut self.table {
            table.leave_device();
        }
        let lost = |what| move |source| CheckpointError::Lost { path: path.into(), what, source };
        let mut checkpoint = Checkpoint::new(self.kind);
        for (key, text) in &self.notes {
            checkpoint.note(key, text.clone());
        }
        if let Some(table) = &self.table {
            table.entries(&mut checkpoint).map_err(lost("the values of its table"))?;
        }
        if let Some(network) = &self.network {
            network.entries(&mut checkpoint).map_err(lost("the copy of its network"))?;
        }
        checkpoint.write(path)
    }
}
