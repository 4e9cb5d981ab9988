//! A checkpoint that is not written yet: a surrogate at one moment. Any thread may write it while the surrogate goes on learning.

use super::checkpoint::Checkpoint;
use super::trainer::NetworkState;
use super::{CheckpointError, Table};
use crate::backend::DeviceError;
use std::path::Path;

/// Gives a table's values, from the device that holds them.
pub(super) type DownloadTable = Box<dyn FnOnce() -> Result<Table, DeviceError> + Send>;

/// Weights, optimizer state and base table at one moment. Numbers are shared with the surrogate until it changes them; copies on a device are
/// downloaded as they are written.
pub struct CheckpointState {
    kind: &'static str,
    notes: Vec<(&'static str, String)>,
    table: Option<DownloadTable>,
    network: Option<NetworkState>,
}

impl CheckpointState {
    pub(super) fn new(
        kind: &'static str,
        notes: Vec<(&'static str, String)>,
        table: Option<DownloadTable>,
        network: Option<NetworkState>,
    ) -> Self {
        Self { kind, notes, table, network }
    }

    /// Why the frames had to wait for the copy; `None` if they did not.
    pub fn wait_reason(&self) -> Option<&str> {
        self.network.as_ref()?.wait_reason()
    }

    /// Writes the file and returns its size in bytes. The file appears under its name when it is whole; until then, and after an error, the previous
    /// file stays.
    ///
    /// # Errors
    /// The file system fails, or the device is lost before its copy is downloaded.
    pub fn write(self, path: &Path) -> Result<u64, CheckpointError> {
        let lost = |what| move |source| CheckpointError::Lost { path: path.into(), what, source };
        // First, since the next slide needs the memory of the table on the device, and the network and the disk take their time.
        let table = self.table.map(|download| download()).transpose().map_err(lost("the values of its table"))?;
        let mut checkpoint = Checkpoint::new(self.kind);
        for (key, text) in &self.notes {
            checkpoint.note(key, text.clone());
        }
        if let Some(table) = &table {
            table.entries(&mut checkpoint);
        }
        if let Some(network) = &self.network {
            network.entries(&mut checkpoint).map_err(lost("the copy of its network"))?;
        }
        checkpoint.write(path)
    }
}
