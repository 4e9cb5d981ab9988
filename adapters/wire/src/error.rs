//! Errors of rings, messages and descriptions.

use crate::RING_VARIABLE;
use std::path::PathBuf;

/// Error of a ring, a message or a description. Nothing was changed, unless stated otherwise.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// A system call failed.
    #[error("{}: {what}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The failed action.
        what: &'static str,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file system is full.
    #[error("{}: no room for a ring of {needed} bytes (fewer slots need less, or a folder on another file system)", path.display())]
    NoSpace {
        /// The ring.
        path: PathBuf,
        /// Bytes of the ring.
        needed: u64,
    },
    /// The ring exceeds the process limit of a file's length.
    #[error("{}: a ring of {needed} bytes exceeds the longest file that this process may create ({limit} bytes: ulimit -f, RLIMIT_FSIZE)", path.display())]
    FileSize {
        /// The ring.
        path: PathBuf,
        /// Bytes of the ring.
        needed: u64,
        /// Limit of the process.
        limit: u64,
    },
    /// The ring lies on a disk or a server, for which a write may have to wait.
    #[error("{}: the file system (type {found:#x}) is not in memory, and the simulation would have to wait for it; accepted: a folder in tmpfs or ramfs, such as /dev/shm", path.display())]
    NotInMemory {
        /// The ring.
        path: PathBuf,
        /// Type of the file system, as in `statfs`.
        found: u64,
    },
    /// Another producer has the ring's name.
    #[error("{}: another producer publishes under this name (process {pid})", path.display())]
    InUse {
        /// The ring.
        path: PathBuf,
        /// Process of that producer; 0 if its ring cannot be read.
        pid: u64,
    },
    /// The file belongs to another user, or others have rights to it.
    #[error("{}: {found}; accepted: a regular file of user {user} that nobody else may open (mode 0600)", path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// The problem.
        found: String,
        /// User of this process.
        user: u32,
    },
    /// The ring's folder belongs to another user, or others may write into it or replace it.
    #[error(
        "{}: {found}; accepted: a folder of user {user} that nobody else may write into or replace. Another one can be named, by {RING_VARIABLE} for instance",
        path.display()
    )]
    ForeignFolder {
        /// The folder.
        path: PathBuf,
        /// The problem.
        found: String,
        /// User of this process.
        user: u32,
    },
    /// The file is no ring.
    #[error("not a ring: it begins with {found:02x?}")]
    NotARing {
        /// First bytes of the file.
        found: [u8; 8],
    },
    /// The format has another version.
    #[error("{what} has version {found}; only version {known} is supported")]
    Version {
        /// The object.
        what: &'static str,
        /// Its version.
        found: u32,
        /// The supported version.
        known: u32,
    },
    /// The header is torn or was changed.
    #[error("the header's checksum is {found:016x}, but that of its bytes is {computed:016x}")]
    Checksum {
        /// Checksum in the header.
        found: u64,
        /// Checksum of its bytes.
        computed: u64,
    },
    /// A value is invalid.
    #[error("`{field}` is {found}; accepted: {accepted}")]
    Field {
        /// Name of the value.
        field: &'static str,
        /// The value found.
        found: String,
        /// The accepted values.
        accepted: String,
    },
    /// A step's time is not finite. This and the next two errors are not [`WireError::Field`], because publishing allocates nothing, not even for errors.
    #[error("`time` is {time}; accepted: a finite number")]
    Time {
        /// The given time.
        time: f64,
    },
    /// The number of components differs from the number of axes.
    #[error("`components` is {found}; accepted: {accepted}, as many as axes")]
    Components {
        /// Number of given components.
        found: usize,
        /// Number of axes.
        accepted: usize,
    },
    /// A component's address is null or misaligned.
    #[error("`component` is at {address:#x}; accepted: an address divisible by {divisor}, not null")]
    Address {
        /// The given address.
        address: usize,
        /// Bytes of a value.
        divisor: usize,
    },
    /// The data end too early.
    #[error("{what} ends after {found} bytes; {needed} are needed")]
    Short {
        /// The object.
        what: &'static str,
        /// Number of bytes.
        found: u64,
        /// Bytes needed.
        needed: u64,
    },
    /// The object exceeds the reader's memory limit.
    #[error("{what} would take {needed} bytes; at most {limit} are allowed")]
    TooLarge {
        /// The object.
        what: &'static str,
        /// Requested bytes.
        needed: u64,
        /// The limit.
        limit: u64,
    },
    /// An allocation failed.
    #[error("no memory for {bytes} bytes")]
    NoMemory {
        /// Requested bytes.
        bytes: usize,
    },
    /// The process is a fork of the one that opened the ring.
    #[error("process {opened} opened the ring, and this is its fork {here}: open another ring under another name here")]
    Forked {
        /// Process that opened the ring.
        opened: u32,
        /// This process.
        here: u32,
    },
    /// The ring's file was removed or replaced while this process published into it. Without its path, because publishing allocates nothing.
    #[error("the ring was removed or replaced while it was open, and no follower finds it: close it and open it again")]
    Removed,
    /// The relay closed the connection after this follower's signature.
    #[error("the relay rejected this follower: another key, or too many followers")]
    Rejected,
    /// A signature is wrong.
    #[error("the signature does not verify: another key, or the message was changed on the way")]
    Signature,
    /// The signature of a message's payload is wrong.
    #[error("the signature of a message's payload does not verify: it was changed on the way")]
    Payload,
    /// A message was received before.
    #[error("message {found} is a replay: the newest is {newest}")]
    Replayed {
        /// Number of the message.
        found: u64,
        /// Newest number received.
        newest: u64,
    },
    /// A block does not fit the field.
    #[error("block {block}: {found}; accepted: {accepted}")]
    Block {
        /// Index of the block.
        block: u32,
        /// The problem.
        found: String,
        /// The accepted blocks.
        accepted: String,
    },
}

impl WireError {
    pub(crate) fn io(path: &std::path::Path, what: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), what, source }
    }

    #[cfg(feature = "messages")]
    pub(crate) fn connection(source: std::io::Error) -> Self {
        Self::io(std::path::Path::new("connection"), "broke", source)
    }

    pub(crate) fn no_memory(bytes: usize) -> Self {
        Self::NoMemory { bytes }
    }

    pub(crate) fn field(field: &'static str, found: impl std::fmt::Display, accepted: impl Into<String>) -> Self {
        Self::Field { field, found: found.to_string(), accepted: accepted.into() }
    }
}
