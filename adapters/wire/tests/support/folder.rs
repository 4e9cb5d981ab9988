//! A ring's folder for one test.

use std::path::PathBuf;
use std::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};

static FORKS: RwLock<()> = RwLock::new(());

#[allow(dead_code)]
enum Beside {
    Others(RwLockReadGuard<'static, ()>),
    Nobody(RwLockWriteGuard<'static, ()>),
}

/// A separate folder in /dev/shm, removed at the end of the test. A test has one at a time.
pub struct Folder(pub PathBuf, #[allow(dead_code)] Beside);

impl Folder {
    pub fn new(name: &str) -> Self {
        Self::of(name, Beside::Others(FORKS.read().unwrap_or_else(|broken| broken.into_inner())))
    }

    /// For a test that forks: no other test runs meanwhile, because the child would hold its files and connections open.
    #[allow(dead_code)]
    pub fn alone(name: &str) -> Self {
        Self::of(name, Beside::Nobody(FORKS.write().unwrap_or_else(|broken| broken.into_inner())))
    }

    fn of(name: &str, beside: Beside) -> Self {
        let path = PathBuf::from("/dev/shm").join(format!("rw-test-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path, beside)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
