//! What can be wrong with a ring, a message or a description.

use std::path::PathBuf;

/// Why something was refused. Nothing was changed, unless said.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The system refused.
    #[error("{}: {what}: {source}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file system is full.
    #[error("{}: no room for a ring of {needed} bytes (fewer slots need less, or a folder on another file system)", path.display())]
    NoSpace {
        /// The ring.
        path: PathBuf,
        /// Its bytes.
        needed: u64,
    },
    /// The process may not have a file so long.
    #[error("{}: a ring of {needed} bytes is longer than this process may make a file ({limit} bytes: ulimit -f, RLIMIT_FSIZE)", path.display())]
    FileSize {
        /// The ring.
        path: PathBuf,
        /// Its bytes.
        needed: u64,
        /// The process's limit.
        limit: u64,
    },
    /// What is written there may have to wait for a disk or a server.
    #[error("{}: the file system (type {found:#x}) is none that lies in memory, so that a simulation could wait for it; accepted: a folder in tmpfs or ramfs, such as /dev/shm", path.display())]
    NotInMemory {
        /// The ring.
        path: PathBuf,
        /// The file system's type, as `statfs` says it.
        found: u64,
    },
    /// Another producer has it.
    #[error("{}: another producer publishes under this name (process {pid})", path.display())]
    InUse {
        /// The ring.
        path: PathBuf,
        /// Whose process, as its ring says; 0 where it does not.
        pid: u64,
    },
    /// The file belongs to somebody else, or others may write it.
    #[error("{}: {found}; accepted: a regular file of user {user} that nobody else may open (mode 0600)", path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        found: String,
        /// Who asks.
        user: u32,
    },
    /// No ring, or another kind of file.
    #[error("not a ring: it begins with {found:02x?}")]
    NotARing {
        /// First bytes.
        found: [u8; 8],
    },
    /// Written by another version.
    #[error("{what} has version {found}; this is version {known} and knows no other")]
    Version {
        /// What of it.
        what: &'static str,
        /// What it says.
        found: u32,
        /// What is known.
        known: u32,
    },
    /// The header is torn or was changed.
    #[error("the header's checksum is {found:016x}, its bytes give {computed:016x}")]
    Checksum {
        /// What it says.
        found: u64,
        /// What its bytes give.
        computed: u64,
    },
    /// A value that cannot be.
    #[error("`{field}` is {found}; accepted: {accepted}")]
    Field {
        /// Which.
        field: &'static str,
        /// What was found.
        found: String,
        /// What is accepted.
        accepted: String,
    },
    /// A step's time. These three are told apart from [`WireError::Field`] since publishing takes no memory, not even for its errors.
    #[error("`time` is {time}; accepted: a finite number")]
    Time {
        /// What was given.
        time: f64,
    },
    /// Another number of components than axes.
    #[error("`components` is {found}; accepted: {accepted}, as many as axes")]
    Components {
        /// How many were given.
        found: usize,
        /// How many there are.
        accepted: usize,
    },
    /// A component's address, null with them.
    #[error("`component` is at {address:#x}; accepted: an address divisible by {divisor}, not null")]
    Address {
        /// What was given.
        address: usize,
        /// Bytes of a value.
        divisor: usize,
    },
    /// It ends before it should.
    #[error("{what} ends after {found} bytes; {needed} are needed")]
    Short {
        /// What.
        what: &'static str,
        /// Bytes there.
        found: u64,
        /// Bytes needed.
        needed: u64,
    },
    /// More memory than the reader allows.
    #[error("{what} would take {needed} bytes; at most {limit} are allowed")]
    TooLarge {
        /// What.
        what: &'static str,
        /// Bytes asked for.
        needed: u64,
        /// The limit.
        limit: u64,
    },
    /// No memory.
    #[error("no memory for {bytes} bytes")]
    NoMemory {
        /// Bytes asked for.
        bytes: usize,
    },
    /// The process is a fork of the one that opened the ring.
    #[error("the ring was opened by process {opened}, this is its fork {here}: open one under another name here")]
    Forked {
        /// Who opened it.
        opened: u32,
        /// Who asks.
        here: u32,
    },
    /// The relay hung up when it had seen what this follower signed.
    #[error("the relay sent this follower away: another key, or more followers than it takes")]
    SentAway,
    /// The signature is not that of the key.
    #[error("the signature does not fit: another key, or the message was changed on the way")]
    Signature,
    /// What came with a message is not what was signed.
    #[error("the signature of a message's payload does not fit: it was changed on the way")]
    Payload,
    /// A message that came before.
    #[error("message {found} is a replay: {newest} came already")]
    Replayed {
        /// Its number.
        found: u64,
        /// Newest seen.
        newest: u64,
    },
    /// Blocks that do not make one field.
    #[error("block {block}: {found}; accepted: {accepted}")]
    Block {
        /// Which.
        block: u32,
        /// What was found.
        found: String,
        /// What is accepted.
        accepted: String,
    },
}

impl WireError {
    pub(crate) fn io(path: &std::path::Path, what: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), what, source }
    }

    pub(crate) fn no_memory(bytes: usize) -> Self {
        Self::NoMemory { bytes }
    }

    pub(crate) fn field(field: &'static str, found: impl std::fmt::Display, accepted: impl Into<String>) -> Self {
        Self::Field { field, found: found.to_string(), accepted: accepted.into() }
    }
}
