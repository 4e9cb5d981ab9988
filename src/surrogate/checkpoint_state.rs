//! State of a surrogate at one moment, before it is written. Any thread may write it while the surrogate continues to train.

use super::checkpoint::Checkpoint;
use super::trainer::NetworkState;
use super::{CheckpointError, Table};
use ridgewatch_base::DeviceError;
use std::path::Path;

/// Downloads a table's values from the device that holds them.
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

    /// Reason why frames had to wait for the copy; `None` if they did not.
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
        // The table comes first: the next slide needs its memory on the device, and network and disk are slow.
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
