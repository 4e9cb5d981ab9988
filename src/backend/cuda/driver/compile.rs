//! Compiles kernel sources to machine code (CUBIN) by NVRTC, with a cache on disk.
//!
//! Each source in `kernels/` is compiled with macros for everything that is constant during a run (dimensions, precision, interpolation, ...). A
//! kernel then contains one variant only and uses no more registers than this variant needs.

use crate::cuda::DeviceError;
use cudarc::nvrtc::{result as nvrtc, sys};
use std::ffi::{CStr, CString};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

macro_rules! kernel_files {
    ($($path:literal),* $(,)?) => {
        &[$(($path, include_str!(concat!("../../../../kernels/", $path)))),*]
    };
}

/// The `.cu` files: path in `kernels/` and text.
pub const SOURCES: &[(&str, &str)] = kernel_files![
    "network/network.cu",
    "network/network_batched.cu",
    "network/network_fused.cu",
    "rendering/answer.cu",
    "rendering/audit.cu",
    "rendering/bricks.cu",
    "rendering/coupled.cu",
    "rendering/combine.cu",
    "rendering/march.cu",
    "rendering/mend.cu",
    "rendering/render.cu",
    "tracing/sort.cu",
    "tracing/table.cu",
    "tracing/trace_closed.cu",
    "tracing/trace_grid.cu",
    "tracing/window.cu",
];

/// The headers: path as in `#include` and text.
const HEADERS: &[(&str, &str)] = kernel_files![
    "common/atomics.cuh",
    "common/base.cuh",
    "common/domain.cuh",
    "common/rng.cuh",
    "common/stretch.cuh",
    "network/network.cuh",
    "network/network_data.cuh",
    "rendering/answer.cuh",
    "rendering/audit.cuh",
    "rendering/camera.cuh",
    "rendering/coupled.cuh",
    "rendering/combine.cuh",
    "rendering/regression.cuh",
    "rendering/film.cuh",
    "rendering/gate.cuh",
    "rendering/light.cuh",
    "rendering/majorant.cuh",
    "rendering/march.cuh",
    "rendering/space.cuh",
    "rendering/tracking.cuh",
    "rendering/transfer.cuh",
    "rendering/wavefront.cuh",
    "tracing/closed.cuh",
    "tracing/closed_variant.cuh",
    "tracing/grid.cuh",
    "tracing/grid_variant.cuh",
    "tracing/integrate.cuh",
    "tracing/missing_cells.cuh",
    "tracing/sphere.cuh",
    "tracing/table.cuh",
    "tracing/variant.cuh",
];

/// NVRTC options of every kernel: only those that speed and parity with the CPU need.
const OPTIONS: &[&str] = &["--std=c++17", "--device-as-default-execution-space", "--extra-device-vectorization", "-lineinfo"];

/// One source with the macros and the architecture that it is compiled for.
#[derive(Debug, Clone)]
pub struct Request {
    name: &'static str,
    text: &'static str,
    arch: String,
    defines: Vec<String>,
}

impl Request {
    /// `source`: name of a file of [`SOURCES`], without its folder; `defines`: macros, `NAME=VALUE`.
    ///
    /// # Errors
    /// [`DeviceError::Unsupported`] if no source has this name.
    pub fn new(source: &str, capability: (i32, i32), defines: &[String]) -> Result<Self, DeviceError> {
        let Some(&(name, text)) = SOURCES.iter().find(|(path, _)| path.rsplit('/').next() == Some(source)) else {
            return Err(DeviceError::Unsupported { what: format!("no kernel source `{source}`") });
        };
        Ok(Self { name, text, arch: format!("sm_{}{}", capability.0, capability.1), defines: defines.to_vec() })
    }

    fn options(&self) -> Vec<String> {
        let mut options: Vec<String> = OPTIONS.iter().map(|o| (*o).to_owned()).collect();
        options.push(format!("--gpu-architecture={}", self.arch));
        options.extend(self.defines.iter().map(|define| format!("-D{define}")));
        options
    }

    /// Compiles to a CUBIN. (A driver older than the compiler would not load PTX.)
    ///
    /// # Errors
    /// [`DeviceError::NoNvrtc`], or [`DeviceError::Compile`] with the compiler's log.
    pub fn compile(&self) -> Result<Vec<u8>, DeviceError> {
        let fault = |log: String| DeviceError::Compile { source_name: self.name.into(), arch: self.arch.clone(), log };
        // SAFETY: the call only looks up the library.
        if !unsafe { sys::is_culib_present() } {
            return Err(DeviceError::NoNvrtc);
        }
        let c = |text: &str| CString::new(text).map_err(|_| fault("a source holds a NUL".into()));
        let (source, name) = (c(self.text)?, c(self.name)?);
        let headers = HEADERS.iter().map(|(name, text)| Ok((c(name)?, c(text)?))).collect::<Result<Vec<_>, DeviceError>>()?;
        let options = self.options().iter().map(|option| c(option)).collect::<Result<Vec<_>, _>>()?;
        let program = Program::new(&source, &name, &headers).map_err(|error| fault(error.to_string()))?;
        program.compile(&options).map_err(|error| fault(format!("{error}\n{}", program.log())))?;
        program.cubin().map_err(|error| fault(error.to_string()))
    }

    /// Everything that determines the machine code.
    fn key(&self) -> String {
        let mut hash = blake3::Hasher::new();
        for part in HEADERS.iter().chain([&(self.name, self.text)]).flat_map(|&(name, text)| [name, text]) {
            hash.update(&(part.len() as u64).to_le_bytes()).update(part.as_bytes());
        }
        let (major, minor) = nvrtc_version();
        format!("ridgewatch kernel {} nvrtc {major}.{minor} sources {} {}\n", self.name, hash.finalize(), self.options().join(" "))
    }
}

/// Version of the NVRTC library, (major, minor); (0, 0) if there is none.
pub fn nvrtc_version() -> (i32, i32) {
    let (mut major, mut minor) = (0, 0);
    // SAFETY: the library is looked up before it is called; the numbers outlive the call.
    unsafe {
        if sys::is_culib_present() {
            let _ = sys::nvrtcVersion(&mut major, &mut minor);
        }
    }
    (major, minor)
}

/// An NVRTC program, destroyed when dropped.
struct Program(sys::nvrtcProgram);

impl Program {
    fn new(source: &CStr, name: &CStr, headers: &[(CString, CString)]) -> Result<Self, nvrtc::NvrtcError> {
        let names: Vec<_> = headers.iter().map(|(name, _)| name.as_ptr()).collect();
        let texts: Vec<_> = headers.iter().map(|(_, text)| text.as_ptr()).collect();
        let mut program = std::ptr::null_mut();
        // SAFETY: all strings end in NUL and outlive the call, which copies them; both arrays hold `headers.len()` pointers.
        unsafe {
            sys::nvrtcCreateProgram(&mut program, source.as_ptr(), name.as_ptr(), headers.len() as i32, texts.as_ptr(), names.as_ptr())
        }
        .result()?;
        Ok(Self(program))
    }

    fn compile(&self, options: &[CString]) -> Result<(), nvrtc::NvrtcError> {
        let options: Vec<_> = options.iter().map(|option| option.as_ptr()).collect();
        // SAFETY: the program is live, and so are the strings.
        unsafe { sys::nvrtcCompileProgram(self.0, options.len() as i32, options.as_ptr()) }.result()
    }

    fn log(&self) -> String {
        // SAFETY: the program is live.
        let bytes = unsafe { nvrtc::get_program_log(self.0) }.unwrap_or_default();
        String::from_utf8_lossy(&bytes.iter().map(|&b| b as u8).take_while(|&b| b != 0).collect::<Vec<_>>()).into_owned()
    }

    fn cubin(&self) -> Result<Vec<u8>, nvrtc::NvrtcError> {
        let mut size = 0;
        // SAFETY: the program is live and compiled; the array has the size that NVRTC reports.
        unsafe {
            sys::nvrtcGetCUBINSize(self.0, &mut size).result()?;
            let mut cubin = vec![0u8; size];
            sys::nvrtcGetCUBIN(self.0, cubin.as_mut_ptr().cast()).result()?;
            Ok(cubin)
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // SAFETY: the program is live and not used again.
        let _ = unsafe { nvrtc::destroy_program(self.0) };
    }
}

/// Cache of compiled kernels on disk. It never fails: an entry that cannot be read is compiled, one that cannot be written is compiled again in
/// the next run.
#[derive(Debug)]
pub struct KernelCache {
    folder: Option<PathBuf>,
}

/// Number of entries; the oldest are removed first.
const MAX_ENTRIES: usize = 512;
/// Length of a hexadecimal checksum and a newline.
const CHECKSUM_LINE: usize = 2 * blake3::OUT_LEN + 1;
/// Size of the largest entry that is read.
const MAX_BYTES: u64 = 64 << 20;

impl KernelCache {
    /// Uses `folder`, or the user's cache folder if it is `None`.
    pub fn new(folder: Option<PathBuf>) -> Self {
        let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        let home = || set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|home| home.join(".cache"))).map(|c| c.join("ridgewatch/kernels"));
        Self { folder: folder.or_else(home) }
    }

    fn path(&self, request: &Request) -> Option<PathBuf> {
        let name = format!("{}.cubin", blake3::hash(request.key().as_bytes()));
        self.folder.as_ref().map(|folder| folder.join(name))
    }

    /// Machine code of an earlier run. A file holds the key, a line with the checksum of the code, and the code.
    pub fn find(&self, request: &Request) -> Option<Vec<u8>> {
        let path = self.path(request)?;
        if fs::metadata(&path).ok()?.len() > MAX_BYTES {
            return None;
        }
        let bytes = fs::read(&path).ok()?;
        let rest = bytes.strip_prefix(request.key().as_bytes())?;
        let (sum, cubin) = rest.split_at_checked(CHECKSUM_LINE)?;
        (sum == format!("{}\n", blake3::hash(cubin)).as_bytes()).then(|| cubin.to_vec())
    }

    /// Stores machine code for later runs: in a temporary file of mode 0600 that is then renamed, so that readers see a whole entry or none.
    pub fn keep(&self, request: &Request, cubin: &[u8]) {
        let Some(path) = self.path(request) else { return };
        if let Err(error) = write_aside(&path, request.key().as_bytes(), cubin) {
            tracing::warn!("compiled kernels are not kept: {}: {error}", path.display());
        }
    }
}

fn write_aside(path: &Path, key: &[u8], cubin: &[u8]) -> std::io::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder)?;
    prune(folder)?;
    // `tempfile` creates files with mode 0600.
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(key)?;
    writeln!(file, "{}", blake3::hash(cubin))?;
    file.write_all(cubin)?;
    file.persist(path).map(|_| ()).map_err(|error| error.error)
}

/// Removes the oldest entries so that there is room for one more.
fn prune(folder: &Path) -> std::io::Result<()> {
    let mut entries: Vec<_> = fs::read_dir(folder)?
        .filter_map(|entry| {
            let path = entry.ok()?.path();
            let modified = fs::metadata(&path).ok()?.modified().ok()?;
            path.extension().is_some_and(|e| e == "cubin").then_some((modified, path))
        })
        .collect();
    if entries.len() >= MAX_ENTRIES {
        entries.sort();
        for (_, path) in &entries[..entries.len() + 1 - MAX_ENTRIES] {
            fs::remove_file(path)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_entry_is_not_used() {
        let folder = tempfile::tempdir().unwrap();
        let cache = KernelCache::new(Some(folder.path().to_owned()));
        let request = Request::new("sort.cu", (9, 0), &[]).unwrap();
        let other = Request::new("sort.cu", (8, 0), &[]).unwrap();
        assert!(cache.find(&request).is_none());
        let cubin = vec![7u8; 1000];
        cache.keep(&request, &cubin);
        assert_eq!(cache.find(&request), Some(cubin));
        assert!(cache.find(&other).is_none(), "another device");
        let path = cache.path(&request).unwrap();
        let whole = fs::read(&path).unwrap();
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        }
        for at in [0, whole.len() / 2, whole.len() - 1] {
            let mut flipped = whole.clone();
            flipped[at] ^= 1;
            fs::write(&path, &flipped).unwrap();
            assert!(cache.find(&request).is_none(), "byte {at} flipped");
        }
        fs::write(&path, &whole[..whole.len() - 1]).unwrap();
        assert!(cache.find(&request).is_none(), "cut short");
        fs::write(&path, b"").unwrap();
        assert!(cache.find(&request).is_none(), "empty");
    }

    #[test]
    fn unknown_sources_are_refused() {
        assert!(matches!(Request::new("none.cu", (9, 0), &[]), Err(DeviceError::Unsupported { .. })));
    }
}
