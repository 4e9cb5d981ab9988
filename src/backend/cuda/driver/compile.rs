//! From kernel sources to machine code: NVRTC for the device found, kept on disk.
//!
//! Each file in `kernels/` is compiled with macros that fix what a run does not change (dimensions, precision, interpolation, ...):
//! the kernel then holds one variant only, with the registers that this variant needs.

use crate::backend::cuda::DeviceError;
use cudarc::nvrtc::{result as nvrtc, sys};
use std::ffi::{CStr, CString};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

macro_rules! kernel {
    ($name:literal) => {
        ($name, include_str!(concat!("../../../../kernels/", $name)))
    };
}

/// The `.cu` files, by name.
pub const SOURCES: &[(&str, &str)] = &[
    kernel!("answer.cu"),
    kernel!("audit.cu"),
    kernel!("network.cu"),
    kernel!("network_batched.cu"),
    kernel!("network_fused.cu"),
    kernel!("render.cu"),
    kernel!("sort.cu"),
    kernel!("table.cu"),
    kernel!("trace_closed.cu"),
    kernel!("trace_grid.cu"),
    kernel!("window.cu"),
];

/// The headers that they include.
pub const HEADERS: &[(&str, &str)] = &[
    kernel!("answer.cuh"),
    kernel!("atomics.cuh"),
    kernel!("audit.cuh"),
    kernel!("base.cuh"),
    kernel!("camera.cuh"),
    kernel!("closed.cuh"),
    kernel!("closed_variant.cuh"),
    kernel!("film.cuh"),
    kernel!("gate.cuh"),
    kernel!("grid.cuh"),
    kernel!("grid_variant.cuh"),
    kernel!("integrate.cuh"),
    kernel!("land.cuh"),
    kernel!("light.cuh"),
    kernel!("majorant.cuh"),
    kernel!("network.cuh"),
    kernel!("network_data.cuh"),
    kernel!("rng.cuh"),
    kernel!("space.cuh"),
    kernel!("sphere.cuh"),
    kernel!("stretch.cuh"),
    kernel!("table.cuh"),
    kernel!("tracking.cuh"),
    kernel!("transfer.cuh"),
    kernel!("wavefront.cuh"),
];

/// Macros that every kernel is compiled without and with: nothing but what speed and parity need.
const OPTIONS: &[&str] = &["--std=c++17", "--device-as-default-execution-space", "--extra-device-vectorization", "-lineinfo"];

/// What is to be compiled.
#[derive(Debug, Clone)]
pub struct Request {
    name: &'static str,
    text: &'static str,
    arch: String,
    defines: Vec<String>,
}

impl Request {
    /// `source` as in [`SOURCES`]; `defines` as `NAME=VALUE`.
    pub fn new(source: &str, capability: (i32, i32), defines: &[String]) -> Result<Self, DeviceError> {
        let Some(&(name, text)) = SOURCES.iter().find(|(name, _)| *name == source) else {
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

    /// Compiles to a CUBIN. (PTX of a compiler newer than the driver would not load.)
    pub fn compile(&self) -> Result<Vec<u8>, DeviceError> {
        let fault = |log: String| DeviceError::Compile { source_name: self.name.into(), arch: self.arch.clone(), log };
        // SAFETY: only looks the library up.
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

    /// Everything that the machine code depends on.
    fn key(&self) -> String {
        let mut hash = Fnv::new();
        for (name, text) in HEADERS.iter().chain([&(self.name, self.text)]) {
            hash.add(name.as_bytes());
            hash.add(text.as_bytes());
        }
        let (major, minor) = nvrtc_version();
        format!("ridgewatch kernel {} nvrtc {major}.{minor} sources {:032x} {}\n", self.name, hash.0, self.options().join(" "))
    }
}

/// (0, 0) where there is none.
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
        // SAFETY: the program is live and compiled; the array has the size that NVRTC says.
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

/// FNV-1a with 128 bits: names files and finds flipped bits; entries are compared by their whole key besides.
struct Fnv(u128);

impl Fnv {
    fn new() -> Self {
        Self(0x6c62_272e_07bb_0142_62b8_2175_6295_c58d)
    }
    fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = (self.0 ^ u128::from(byte)).wrapping_mul(0x0000_0000_0100_0000_0000_0000_0000_013b);
        }
        self.0 = (self.0 ^ 0xff).wrapping_mul(0x0000_0000_0100_0000_0000_0000_0000_013b);
    }
    fn of(bytes: &[u8]) -> u128 {
        let mut hash = Self::new();
        hash.add(bytes);
        hash.0
    }
}

/// Compiled kernels on disk. Never fails: what cannot be read is compiled, what cannot be written is compiled again next time.
#[derive(Debug)]
pub struct KernelCache {
    folder: Option<PathBuf>,
}

/// Entries kept; the oldest go first.
const MOST_ENTRIES: usize = 512;
/// Largest entry that is read.
const MOST_BYTES: u64 = 64 << 20;

impl KernelCache {
    /// In `folder`, else in the user's cache folder.
    pub fn new(folder: Option<PathBuf>) -> Self {
        let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        let home = || set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|home| home.join(".cache"))).map(|c| c.join("ridgewatch/kernels"));
        Self { folder: folder.or_else(home) }
    }

    fn path(&self, request: &Request) -> Option<PathBuf> {
        let name = format!("{:032x}.cubin", Fnv::of(request.key().as_bytes()));
        self.folder.as_ref().map(|folder| folder.join(name))
    }

    /// The machine code of an earlier run: key, a line with the checksum, code.
    pub fn find(&self, request: &Request) -> Option<Vec<u8>> {
        let path = self.path(request)?;
        if fs::metadata(&path).ok()?.len() > MOST_BYTES {
            return None;
        }
        let bytes = fs::read(&path).ok()?;
        let rest = bytes.strip_prefix(request.key().as_bytes())?;
        let (sum, cubin) = rest.split_at_checked(33)?;
        (sum == format!("{:032x}\n", Fnv::of(cubin)).as_bytes()).then(|| cubin.to_vec())
    }

    /// Keeps machine code for later runs: written aside with mode 0600 and renamed, so that a reader sees all or nothing.
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
    writeln!(file, "{:032x}", Fnv::of(cubin))?;
    file.write_all(cubin)?;
    file.persist(path).map(|_| ()).map_err(|error| error.error)
}

/// Makes room for one more entry.
fn prune(folder: &Path) -> std::io::Result<()> {
    let mut entries: Vec<_> = fs::read_dir(folder)?
        .filter_map(|entry| {
            let path = entry.ok()?.path();
            let modified = fs::metadata(&path).ok()?.modified().ok()?;
            path.extension().is_some_and(|e| e == "cubin").then_some((modified, path))
        })
        .collect();
    if entries.len() >= MOST_ENTRIES {
        entries.sort();
        for (_, path) in &entries[..entries.len() + 1 - MOST_ENTRIES] {
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
