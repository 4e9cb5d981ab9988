//! A folder that is held open. Its files are created, renamed and removed relative to it, wherever its path leads later, and no link in it is
//! followed.

use rustix::fs::{AtFlags, CWD, Dir, FileType, FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};

/// Attempts to open a file that others rename at the same time.
const ATTEMPTS: usize = 100;

/// A folder that is held open.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    handle: OwnedFd,
}

/// Lock of a folder, until it is dropped or the process ends.
#[derive(Debug)]
pub struct Lock {
    /// `None` on file systems without locks.
    _held: Option<File>,
}

impl Folder {
    /// Opens a folder that exists. Links in the path are followed: the caller named it.
    ///
    /// # Errors
    /// Errors of the system; `NotADirectory` if it is a file.
    pub fn open(path: &Path) -> io::Result<Self> {
        let handle = rustix::fs::openat(CWD, path, OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC, Mode::empty())?;
        Ok(Self { path: path.to_owned(), handle })
    }

    /// Opens a folder inside this one, which must not be a link. `None` if there is none.
    ///
    /// # Errors
    /// Errors of the system; a link or a file of that name.
    pub fn existing(&self, name: &str) -> io::Result<Option<Self>> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        match rustix::fs::openat(&self.handle, name, flags, Mode::empty()) {
            Ok(handle) => Ok(Some(Self { path: self.path.join(name), handle })),
            Err(Errno::NOENT) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Opens a folder inside this one, which is made if it does not exist.
    ///
    /// # Errors
    /// As [`Folder::existing`].
    pub fn inner(&self, name: &str) -> io::Result<Self> {
        match rustix::fs::mkdirat(&self.handle, name, Mode::from_raw_mode(0o777)) {
            Ok(()) | Err(Errno::EXIST) => {}
            Err(error) => return Err(error.into()),
        }
        self.existing(name)?.ok_or_else(|| ErrorKind::NotFound.into())
    }

    /// The path by which it was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that nobody else can put files or links in here.
    ///
    /// # Errors
    /// `PermissionDenied`: another user owns it, or all users may write into it.
    pub fn check_owner(&self) -> io::Result<()> {
        let (about, user) = (rustix::fs::fstat(&self.handle)?, rustix::process::geteuid().as_raw());
        let refuse = |found: String| {
            let accepted = format!("accepted: a folder of user {user}, into which not all users may write");
            Err(io::Error::new(ErrorKind::PermissionDenied, format!("{} {found}; {accepted}", self.path.display())))
        };
        if about.st_uid != user {
            return refuse(format!("belongs to user {}", about.st_uid));
        }
        if about.st_mode & 0o002 != 0 {
            return refuse(format!("has mode {:04o}", about.st_mode & 0o7777));
        }
        Ok(())
    }

    /// Creates a file, for appending.
    ///
    /// # Errors
    /// Errors of the system; `AlreadyExists` if there is anything of that name, also a link that leads nowhere.
    pub fn create_new(&self, name: impl AsRef<OsStr>) -> io::Result<File> {
        let flags = OFlags::WRONLY | OFlags::APPEND | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        Ok(rustix::fs::openat(&self.handle, name.as_ref(), flags, Mode::from_raw_mode(0o666))?.into())
    }

    /// Writes a file beside its place and renames it, so that an unfinished file never has the final name. What an earlier attempt left beside it
    /// goes first.
    ///
    /// # Errors
    /// Errors of the system; then the place is unchanged.
    pub fn write_whole(&self, name: impl AsRef<OsStr>, bytes: &[u8]) -> io::Result<()> {
        self.write_with(name, |file| file.write_all(bytes))
    }

    /// As [`Folder::write_whole`], with what `write` puts into the new file.
    ///
    /// # Errors
    /// Errors of the system and of `write`; then the place is unchanged.
    pub fn write_with<E: From<io::Error>>(&self, name: impl AsRef<OsStr>, write: impl FnOnce(&mut File) -> Result<(), E>) -> Result<(), E> {
        let name = name.as_ref();
        let part = [".".as_ref(), name, ".part".as_ref()].into_iter().collect::<OsString>();
        match self.remove(&part) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error.into()),
            _ => {}
        }
        let written = self.create_new(&part).map_err(E::from).and_then(|mut file| write(&mut file));
        let written = written.and_then(|()| Ok(self.rename(&part, self, name)?));
        if written.is_err() {
            // It may not exist; `written` has the error that matters.
            let _ = self.remove(&part);
        }
        written
    }

    /// Opens a file that is written beside its place and then renamed: empty, and locked until it is closed, so that one process writes it at a
    /// time. What a killed process left of it is used again. Where the file system has no locks, nothing is locked.
    ///
    /// # Errors
    /// Errors of the system; `WouldBlock` if another process writes it.
    pub fn open_part(&self, part: &OsStr) -> io::Result<File> {
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        for _ in 0..ATTEMPTS {
            let file: File = match rustix::fs::openat(&self.handle, part, flags, Mode::from_raw_mode(0o666)) {
                // A link.
                Err(Errno::LOOP) => {
                    self.remove(part)?;
                    continue;
                }
                file => file?.into(),
            };
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) | Err(Errno::NOLCK | Errno::NOSYS | Errno::OPNOTSUPP) => {}
                Err(Errno::WOULDBLOCK) => {
                    let path = self.path.join(part);
                    return Err(io::Error::new(ErrorKind::WouldBlock, format!("another process writes {}", path.display())));
                }
                Err(error) => return Err(error.into()),
            }
            let (about, named) = (rustix::fs::fstat(&file)?, rustix::fs::statat(&self.handle, part, AtFlags::SYMLINK_NOFOLLOW));
            if !named.is_ok_and(|named| (named.st_dev, named.st_ino) == (about.st_dev, about.st_ino)) {
                // Its process has renamed it before it was locked here: what it has become must stay.
                continue;
            }
            let regular = FileType::from_raw_mode(about.st_mode) == FileType::RegularFile;
            if regular && about.st_nlink == 1 && about.st_uid == rustix::process::geteuid().as_raw() {
                file.set_len(0)?;
                return Ok(file);
            }
            // A pipe, or a file that has another name too.
            self.remove(part)?;
        }
        Err(io::Error::other(format!("{} was replaced {ATTEMPTS} times while it was opened", self.path.join(part).display())))
    }

    /// Moves a file into a folder of the same file system, which may be this one.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn rename(&self, name: impl AsRef<OsStr>, to: &Self, new: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::renameat(&self.handle, name.as_ref(), &to.handle, new.as_ref())?)
    }

    /// Removes a file, or a link itself.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::unlinkat(&self.handle, name.as_ref(), AtFlags::empty())?)
    }

    /// Removes an empty folder inside this one.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn remove_folder(&self, name: &str) -> io::Result<()> {
        Ok(rustix::fs::unlinkat(&self.handle, name, AtFlags::REMOVEDIR)?)
    }

    /// Brings names that were changed in it to the disk.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn sync(&self) -> io::Result<()> {
        Ok(rustix::fs::fsync(&self.handle)?)
    }

    /// Names of everything in the folder.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn names(&self) -> io::Result<Vec<OsString>> {
        let mut names = Vec::new();
        for entry in Dir::read_from(&self.handle)? {
            let name = OsString::from_vec(entry?.file_name().to_bytes().to_vec());
            if name != "." && name != ".." {
                names.push(name);
            }
        }
        Ok(names)
    }

    /// Whether there is anything of this name.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        rustix::fs::statat(&self.handle, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW).is_ok()
    }

    /// Length of a regular file in bytes; `None` for anything else.
    pub fn length(&self, name: impl AsRef<OsStr>) -> Option<u64> {
        let about = rustix::fs::statat(&self.handle, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW).ok()?;
        (FileType::from_raw_mode(about.st_mode) == FileType::RegularFile).then_some(about.st_size as u64)
    }

    /// Takes the lock of the folder, with the process's id in the file `name`, which stays. Where the file system has no locks, nothing is locked.
    ///
    /// # Errors
    /// `WouldBlock` if another process holds it, with its id if it is known; errors of the system; a link of that name.
    pub fn lock(&self, name: &str) -> io::Result<Lock> {
        // O_NONBLOCK: a pipe of that name would be waited for.
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let mut file: File = rustix::fs::openat(&self.handle, name, flags, Mode::from_raw_mode(0o644))?.into();
        if !file.metadata()?.is_file() {
            return Err(io::Error::new(ErrorKind::InvalidInput, format!("{name} is no regular file")));
        }
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {
                file.set_len(0)?;
                writeln!(file, "{}", std::process::id())?;
                Ok(Lock { _held: Some(file) })
            }
            Err(Errno::WOULDBLOCK) => Err(io::Error::new(ErrorKind::WouldBlock, named(file))),
            Err(Errno::NOLCK | Errno::NOSYS | Errno::OPNOTSUPP) => Ok(Lock { _held: None }),
            Err(error) => Err(error.into()),
        }
    }

    /// The process that holds the lock `name`; `None` if none does. Changes nothing.
    ///
    /// # Errors
    /// Errors of the system; a link of that name.
    pub fn holder(&self, name: &str) -> io::Result<Option<String>> {
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file: File = match rustix::fs::openat(&self.handle, name, flags, Mode::empty()) {
            Err(Errno::NOENT) => return Ok(None),
            file => file?.into(),
        };
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared) {
            Err(Errno::WOULDBLOCK) => Ok(Some(named(file))),
            _ => Ok(None),
        }
    }
}

/// The process that a lock's file names.
fn named(file: File) -> String {
    let mut holder = String::new();
    // A process that has just taken the lock has not written its number yet.
    let _ = file.take(20).read_to_string(&mut holder);
    holder.trim().parse::<u32>().map_or("another process".to_owned(), |id| format!("process {id}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    fn opened() -> (tempfile::TempDir, Folder) {
        let temporary = tempfile::tempdir().unwrap();
        let folder = Folder::open(temporary.path()).unwrap();
        (temporary, folder)
    }

    #[test]
    fn no_link_in_it_is_followed() {
        let (temporary, folder) = opened();
        let victim = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(victim.path(), "precious").unwrap();
        for link in ["records", ".summary.part", "summary"] {
            symlink(victim.path(), temporary.path().join(link)).unwrap();
        }
        symlink("/nowhere/at/all", temporary.path().join("dangling")).unwrap();
        assert_eq!(folder.create_new("records").unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(folder.create_new("dangling").unwrap_err().kind(), ErrorKind::AlreadyExists);
        folder.write_whole("summary", b"ours").unwrap();
        assert_eq!(std::fs::read(temporary.path().join("summary")).unwrap(), b"ours");
        assert_eq!((folder.length("summary"), folder.length("records")), (Some(4), None));
        assert_eq!(std::fs::read(victim.path()).unwrap(), b"precious");
        let elsewhere = tempfile::tempdir().unwrap();
        symlink(elsewhere.path(), temporary.path().join("frames")).unwrap();
        assert!(folder.inner("frames").is_err());
        assert!(folder.lock("dangling").is_err());
    }

    #[test]
    fn a_pipe_in_the_way_is_not_waited_for() {
        let (temporary, folder) = opened();
        let pipe = |name: &str| assert!(std::process::Command::new("mkfifo").arg(temporary.path().join(name)).status().unwrap().success());
        pipe(".summary.part");
        folder.write_whole("summary", b"ours").unwrap();
        pipe("lock");
        assert!(folder.lock("lock").unwrap_err().to_string().contains("no regular file"));
    }

    #[test]
    fn what_a_killed_writer_left_is_used_again_and_nothing_else() {
        let (temporary, folder) = opened();
        let (path, name) = (temporary.path().join(".weights.part"), OsStr::new(".weights.part"));
        std::fs::write(&path, "half").unwrap();
        let mut part = folder.open_part(name).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"");
        let refused = folder.open_part(name).unwrap_err();
        assert!(refused.kind() == ErrorKind::WouldBlock && refused.to_string().contains(".weights.part"), "{refused}");
        part.write_all(b"whole").unwrap();
        // What it has become stays, also while it is open.
        folder.rename(name, &folder, "weights").unwrap();
        let next = folder.open_part(name).unwrap();
        assert_eq!(std::fs::read(temporary.path().join("weights")).unwrap(), b"whole");
        drop((part, next));
        // Other names of a file, and what is no file, are replaced.
        let victim = temporary.path().join("victim");
        std::fs::write(&victim, "precious").unwrap();
        let fifo = |path: &Path| assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
        for odd in
            [&|| symlink(&victim, &path).unwrap(), &|| std::fs::hard_link(&victim, &path).unwrap(), &|| fifo(&path)] as [&dyn Fn(); 3]
        {
            folder.remove(name).unwrap();
            odd();
            folder.open_part(name).unwrap().write_all(b"ours").unwrap();
            assert_eq!((std::fs::read(&path).unwrap(), std::fs::read(&victim).unwrap()), (b"ours".to_vec(), b"precious".to_vec()));
        }
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        assert!(folder.open_part(name).is_err());
    }

    #[test]
    fn files_go_where_the_folder_went() {
        let (temporary, folder) = opened();
        let inner = folder.inner("frames").unwrap();
        std::fs::rename(temporary.path().join("frames"), temporary.path().join("away")).unwrap();
        inner.write_whole("one", b"1").unwrap();
        assert!(temporary.path().join("away/one").exists() && inner.names().unwrap() == ["one"]);
        assert!(folder.existing("frames").unwrap().is_none() && folder.has("away"));
        inner.rename("one", &folder, "two").unwrap();
        folder.remove_folder("away").unwrap();
        assert_eq!(folder.names().unwrap(), ["two"]);
    }

    #[test]
    fn a_folder_that_others_may_write_into_is_refused() {
        let (temporary, folder) = opened();
        folder.check_owner().unwrap();
        std::fs::set_permissions(temporary.path(), std::fs::Permissions::from_mode(0o777)).unwrap();
        let refused = folder.check_owner().unwrap_err();
        assert!(refused.kind() == ErrorKind::PermissionDenied && refused.to_string().contains("has mode 0777"), "{refused}");
        // Only root can make a folder of another user.
        if rustix::process::geteuid().is_root() {
            std::fs::set_permissions(temporary.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
            std::os::unix::fs::chown(temporary.path(), Some(4711), None).unwrap();
            assert!(folder.check_owner().unwrap_err().to_string().contains("belongs to user 4711"));
        }
    }

    #[test]
    fn a_lock_excludes_others_while_it_is_held() {
        let (_temporary, folder) = opened();
        let held = folder.lock(".lock").unwrap();
        let refused = folder.lock(".lock").unwrap_err();
        let holder = format!("process {}", std::process::id());
        assert_eq!((refused.kind(), refused.to_string()), (ErrorKind::WouldBlock, holder.clone()));
        assert_eq!(folder.holder(".lock").unwrap(), Some(holder));
        drop(held);
        // A child that another test starts has the file open until it becomes another program.
        let limit = std::time::Instant::now() + std::time::Duration::from_secs(5);
        while folder.holder(".lock").unwrap().is_some() && std::time::Instant::now() < limit {
            std::thread::yield_now();
        }
        assert_eq!((folder.holder(".lock").unwrap(), folder.holder("none").unwrap()), (None, None));
        folder.lock(".lock").unwrap();
    }
}
