//! Endpoints: `tcp://HOST:PORT`, `ipc://PATH`, and the place that only this user reaches.

use crate::owner::Owner;
use rustix::fs::{CWD, FlockOperation, Mode, OFlags, flock, openat};
use rustix::io::Errno;
use std::fs::{DirBuilder, File, Permissions};
use std::io::{self, ErrorKind};
use std::net::{SocketAddr, TcpListener, ToSocketAddrs};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use thiserror::Error;

/// Maximum length of the path of a Unix socket, in bytes.
const MAX_PATH: usize = 107;
/// Longest wait for the lock of a socket's folder. Programs like this one hold it for a moment; whoever may read the folder can hold it for ever.
const LOCK_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause between two attempts to take it.
const PAUSE: Duration = Duration::from_millis(10);

/// Whose connections are accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peers {
    /// Processes of this machine that run as the user of this process.
    User,
    /// Whoever reaches the endpoint.
    Any,
}

impl Peers {
    pub(crate) fn accept(self, owner: Owner) -> bool {
        self == Self::Any || owner == Owner::User(user())
    }
}

/// Why a socket cannot listen.
#[derive(Debug, Error)]
pub enum BindError {
    /// Not an endpoint.
    #[error("{0}")]
    Endpoint(String),
    /// Another program listens there.
    #[error("another program listens there")]
    InUse,
    /// A file or folder that is not this user's.
    #[error("{path} {found}; accepted: what belongs to this user alone", path = path.display())]
    Foreign {
        /// File or folder.
        path: PathBuf,
        /// What was found.
        found: String,
    },
    /// The folder of the private socket cannot be used, because another user has made it for instance.
    #[error(
        "{path} {found}; accepted: a folder of user {user} with mode 0700 (set XDG_RUNTIME_DIR to such a folder, or name a socket in one: ipc://PATH)",
        path = path.display()
    )]
    NotPrivate {
        /// The folder.
        path: PathBuf,
        /// What was found.
        found: String,
        /// User of this process.
        user: u32,
    },
    /// Another process keeps the folder of a socket locked.
    #[error(
        "{path} has been locked by another process for {LOCK_TIMEOUT:?}; accepted: a folder that only this user may read",
        path = path.display()
    )]
    Locked {
        /// The folder.
        path: PathBuf,
    },
    /// An error of the system.
    #[error(transparent)]
    System(#[from] io::Error),
}

/// A socket that listens. Its file, if it has one, is removed with it.
#[derive(Debug)]
pub(crate) enum Bound {
    Tcp(TcpListener),
    Unix(UnixListener, SocketFile),
}

/// File of a Unix socket, removed at the end unless another one has its name by then.
#[derive(Debug)]
pub(crate) struct SocketFile {
    path: PathBuf,
    identity: (u64, u64),
}

impl SocketFile {
    /// Changes the mode of the socket, and of nothing else that has its name by now.
    fn set_mode(&self, mode: u32) -> io::Result<()> {
        let file: File = openat(CWD, &self.path, OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC, Mode::empty())?.into();
        let about = file.metadata()?;
        if (about.dev(), about.ino()) != self.identity {
            return Err(io::Error::other(format!("{} was replaced", self.path.display())));
        }
        // `fchmod` refuses descriptors of O_PATH, and no other can be opened for a socket. This link leads to the open file, whatever its name.
        std::fs::set_permissions(format!("/proc/self/fd/{}", file.as_raw_fd()), Permissions::from_mode(mode))
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        let about = std::fs::symlink_metadata(&self.path);
        if about.is_ok_and(|about| (about.dev(), about.ino()) == self.identity) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Place that an endpoint names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place<'a> {
    Unix(&'a Path),
    /// Host, without the brackets of an IPv6 address, and port.
    Tcp(&'a str, u16),
}

impl<'a> Place<'a> {
    /// Reads an endpoint; does not look up its host. The error is what is wrong.
    pub fn of(endpoint: &'a str) -> Result<Self, String> {
        if let Some(path) = endpoint.strip_prefix("ipc://") {
            let bytes = path.len();
            if !path.starts_with('/') || bytes > MAX_PATH {
                return Err(format!("the path has {bytes} bytes; accepted is a path from the root of at most {MAX_PATH} bytes"));
            }
            return Ok(Self::Unix(Path::new(path)));
        }
        let address = endpoint.strip_prefix("tcp://").ok_or("neither tcp:// nor ipc://")?;
        let (host, port) = address.rsplit_once(':').ok_or("it has no port")?;
        let port: u16 = port.parse().map_err(|_| format!("`{port}` is not a port from 0 to 65535"))?;
        match host.trim_start_matches('[').trim_end_matches(']') {
            "" => Err("it has no host".to_owned()),
            host => Ok(Self::Tcp(host, port)),
        }
    }
}

/// Checks an endpoint to connect to, without looking up its host.
///
/// # Errors
/// What is wrong with it.
pub fn check_endpoint(endpoint: &str) -> Result<(), String> {
    Place::of(endpoint).map(drop)
}

impl Bound {
    /// Binds an endpoint; returns it with the port that was bound.
    pub fn open(endpoint: &str) -> Result<(Self, String), BindError> {
        let wrong = BindError::Endpoint;
        let (host, port) = match Place::of(endpoint).map_err(wrong)? {
            Place::Unix(path) => {
                let (listener, file) = unix(path)?;
                return Ok((Self::Unix(listener, file), endpoint.to_owned()));
            }
            Place::Tcp("*", port) => ("0.0.0.0", port),
            Place::Tcp(host, port) => (host, port),
        };
        let addresses: Vec<_> = (host, port).to_socket_addrs().map_err(|e| wrong(format!("host `{host}` is unknown: {e}")))?.collect();
        // The standard library sets SO_REUSEADDR, so that only a listener blocks the port, not connections of an earlier run.
        let listener = TcpListener::bind(addresses.as_slice()).map_err(in_use)?;
        let resolved = format!("tcp://{}", listener.local_addr()?);
        Ok((Self::Tcp(listener), resolved))
    }

    /// Whether only this machine reaches it.
    pub fn is_local(&self) -> bool {
        match self {
            Self::Tcp(listener) => listener.local_addr().is_ok_and(|address: SocketAddr| address.ip().to_canonical().is_loopback()),
            Self::Unix(..) => true,
        }
    }

    /// Lets other users connect to a Unix socket, or nobody else.
    pub fn open_to(&self, peers: Peers) -> io::Result<()> {
        match self {
            Self::Tcp(_) => Ok(()),
            Self::Unix(_, file) => file.set_mode(if peers == Peers::User { 0o600 } else { 0o666 }),
        }
    }
}

fn in_use(error: io::Error) -> BindError {
    if error.kind() == ErrorKind::AddrInUse { BindError::InUse } else { error.into() }
}

fn unix(path: &Path) -> Result<(UnixListener, SocketFile), BindError> {
    // Two programs must not take each other's new socket for a left one.
    let _lock = lock_folder(path.parent().unwrap_or(path))?;
    let listener = match UnixListener::bind(path) {
        Err(error) if error.kind() == ErrorKind::AddrInUse => {
            remove_left(path)?;
            UnixListener::bind(path).map_err(in_use)?
        }
        bound => bound?,
    };
    let about = std::fs::symlink_metadata(path)?;
    Ok((listener, SocketFile { path: path.to_owned(), identity: (about.dev(), about.ino()) }))
}

/// Locks a folder until the value is dropped.
fn lock_folder(path: &Path) -> Result<File, BindError> {
    let (folder, begin) = (File::open(path)?, Instant::now());
    loop {
        match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(folder),
            Err(Errno::WOULDBLOCK) if begin.elapsed() < LOCK_TIMEOUT => std::thread::sleep(PAUSE),
            Err(Errno::WOULDBLOCK) => return Err(BindError::Locked { path: path.to_owned() }),
            Err(error) => return Err(io::Error::from(error).into()),
        }
    }
}

/// Removes a socket of this user that an ended program left.
fn remove_left(path: &Path) -> Result<(), BindError> {
    let about = std::fs::symlink_metadata(path)?;
    let foreign = |found: &str| Err(BindError::Foreign { path: path.to_owned(), found: found.to_owned() });
    if !about.file_type().is_socket() {
        return foreign("exists and is no socket");
    }
    if about.uid() != user() {
        return foreign(&format!("belongs to user {}", about.uid()));
    }
    match UnixStream::connect(path) {
        Err(error) if error.kind() == ErrorKind::ConnectionRefused => Ok(std::fs::remove_file(path)?),
        _ => Err(BindError::InUse),
    }
}

fn user() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// Endpoint of a Unix socket in a folder that only this user enters: `$XDG_RUNTIME_DIR/ridgewatch` if the system has made that variable's folder
/// for this user, else `/dev/shm/ridgewatch-UID`. Creates the folder.
///
/// # Errors
/// The folder cannot be created, or others have rights to it.
pub fn private_endpoint(name: &str) -> Result<String, BindError> {
    private_in(&private_folder(std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from)), name)
}

/// By the number of the user: names of users in the environment may be those of others, after `su` for instance.
fn private_folder(runtime: Option<PathBuf>) -> PathBuf {
    match runtime.filter(|folder| folder.is_absolute() && check_private(folder).is_ok()) {
        Some(folder) => folder.join("ridgewatch"),
        None => PathBuf::from(format!("/dev/shm/ridgewatch-{}", user())),
    }
}

fn private_in(folder: &Path, name: &str) -> Result<String, BindError> {
    let checked = match DirBuilder::new().mode(0o700).create(folder) {
        Err(error) if error.kind() != ErrorKind::AlreadyExists => Err(format!("cannot be created: {error}")),
        _ => check_private(folder),
    };
    checked.map_err(|found| BindError::NotPrivate { path: folder.to_owned(), found, user: user() })?;
    Ok(format!("ipc://{}", folder.join(name).display()))
}

/// Checks that a folder is this user's alone. The error is what was found.
fn check_private(folder: &Path) -> Result<(), String> {
    let about = std::fs::symlink_metadata(folder).map_err(|error| format!("cannot be examined: {error}"))?;
    if !about.is_dir() {
        Err("is no folder".to_owned())
    } else if about.uid() != user() {
        Err(format!("belongs to user {}", about.uid()))
    } else if about.mode() & 0o077 != 0 {
        Err(format!("has mode {:04o}", about.mode() & 0o7777))
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_checked() {
        for (endpoint, hint) in [
            ("udp://127.0.0.1:5577", "neither"),
            ("tcp://127.0.0.1", "no port"),
            ("tcp://127.0.0.1:99999", "not a port from 0"),
            ("tcp://:5577", "no host"),
            ("tcp://no such host:5577", "unknown"),
            ("ipc://frames", "from the root"),
            (&format!("ipc:///{}", "a".repeat(107)), "108 bytes"),
        ] {
            let error = Bound::open(endpoint).unwrap_err().to_string();
            assert!(error.contains(hint), "{error}");
        }
        let (bound, resolved) = Bound::open("tcp://127.0.0.1:0").unwrap();
        assert!(bound.is_local() && !resolved.ends_with(":0"));
        assert!(matches!(Bound::open(&resolved), Err(BindError::InUse)));
        assert!(!Bound::open("tcp://*:0").unwrap().0.is_local());
    }

    #[test]
    fn a_left_socket_is_replaced_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames");
        let endpoint = format!("ipc://{}", path.display());
        // Dropping the listener alone leaves its file, as a killed program does.
        drop(UnixListener::bind(&path).unwrap());
        let (bound, _) = Bound::open(&endpoint).unwrap();
        assert!(matches!(Bound::open(&endpoint), Err(BindError::InUse)));
        for (peers, mode) in [(Peers::User, 0o600), (Peers::Any, 0o666)] {
            bound.open_to(peers).unwrap();
            assert_eq!(path.metadata().unwrap().mode() & 0o777, mode);
        }
        drop(bound);
        assert!(!path.exists());
        std::fs::write(&path, "mine").unwrap();
        let error = Bound::open(&endpoint).unwrap_err().to_string();
        assert!(error.contains("no socket") && error.contains(path.to_str().unwrap()), "{error}");
        assert!(path.exists());
        // A socket that has taken the name meanwhile stays.
        std::fs::remove_file(&path).unwrap();
        let (bound, _) = Bound::open(&endpoint).unwrap();
        std::fs::rename(&path, folder.path().join("old")).unwrap();
        let _other = UnixListener::bind(&path).unwrap();
        drop(bound);
        assert!(path.exists());
    }

    #[test]
    fn the_private_folder_is_this_users_alone() {
        let folder = tempfile::tempdir().unwrap();
        let own = folder.path().join("own");
        let endpoint = private_in(&own, "frames").unwrap();
        assert_eq!(endpoint, format!("ipc://{}/frames", own.display()));
        assert_eq!(own.metadata().unwrap().mode() & 0o777, 0o700);
        private_in(&own, "frames").unwrap();
        std::fs::set_permissions(&own, Permissions::from_mode(0o755)).unwrap();
        let error = private_in(&own, "frames").unwrap_err().to_string();
        assert!(error.contains("mode 0755"), "{error}");
        std::os::unix::fs::symlink(folder.path(), folder.path().join("link")).unwrap();
        assert!(private_in(&folder.path().join("link"), "frames").unwrap_err().to_string().contains("no folder"));
        assert!(
            private_in(&folder.path().join("missing/own"), "frames").unwrap_err().to_string().contains("missing/own cannot be created")
        );
    }

    #[test]
    fn a_private_folder_that_another_user_made_first_is_refused_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let taken = folder.path().join("taken");
        std::fs::write(&taken, "").unwrap();
        // Only root can make a folder of another user; a file in the way is refused likewise.
        if user() == 0 {
            std::fs::remove_file(&taken).unwrap();
            std::fs::create_dir(&taken).unwrap();
            std::os::unix::fs::chown(&taken, Some(4711), None).unwrap();
        }
        let error = private_in(&taken, "frames").unwrap_err().to_string();
        let found = if user() == 0 { "belongs to user 4711" } else { "is no folder" };
        for part in [taken.to_str().unwrap(), found, "with mode 0700", "XDG_RUNTIME_DIR", "ipc://PATH"] {
            assert!(error.contains(part), "{error}");
        }
        // The same folder in every environment of this user.
        let shared = PathBuf::from(format!("/dev/shm/ridgewatch-{}", user()));
        assert_eq!([None, Some(taken), Some("run".into())].map(private_folder), [(); 3].map(|()| shared.clone()));
        std::fs::set_permissions(folder.path(), Permissions::from_mode(0o700)).unwrap();
        assert_eq!(private_folder(Some(folder.path().to_owned())), folder.path().join("ridgewatch"));
    }

    #[test]
    fn a_folder_that_somebody_keeps_locked_is_refused_in_time() {
        let folder = tempfile::tempdir().unwrap();
        let endpoint = format!("ipc://{}/frames", folder.path().display());
        let theirs = File::open(folder.path()).unwrap();
        flock(&theirs, FlockOperation::LockExclusive).unwrap();
        let (send, receive) = std::sync::mpsc::channel();
        let (binding, path) = (endpoint.clone(), folder.path().display().to_string());
        std::thread::spawn(move || send.send(Bound::open(&binding).map(drop)));
        let error = receive.recv_timeout(10 * LOCK_TIMEOUT).unwrap().unwrap_err().to_string();
        assert!(error.contains(&path) && error.contains("locked by another process"), "{error}");
        // A lock that is held for a moment is waited for.
        let late = std::thread::spawn(move || {
            std::thread::sleep(5 * PAUSE);
            drop(theirs);
        });
        Bound::open(&endpoint).unwrap();
        late.join().unwrap();
    }

    #[test]
    fn the_mode_of_nothing_but_the_socket_is_changed() {
        let folder = tempfile::tempdir().unwrap();
        let (path, victim) = (folder.path().join("frames"), folder.path().join("victim"));
        std::fs::write(&victim, "").unwrap();
        std::fs::set_permissions(&victim, Permissions::from_mode(0o640)).unwrap();
        let (bound, _) = Bound::open(&format!("ipc://{}", path.display())).unwrap();
        std::fs::rename(&path, folder.path().join("old")).unwrap();
        std::os::unix::fs::symlink(&victim, &path).unwrap();
        assert!(bound.open_to(Peers::Any).unwrap_err().to_string().contains("was replaced"));
        std::fs::remove_file(&path).unwrap();
        std::fs::hard_link(&victim, &path).unwrap();
        assert!(bound.open_to(Peers::Any).is_err());
        assert_eq!(victim.metadata().unwrap().mode() & 0o777, 0o640);
    }
}
