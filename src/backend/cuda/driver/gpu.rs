//! One GPU: asked for before it is touched, its context, streams, memory and compiled kernels.

use crate::backend::cuda::DeviceError;
use crate::backend::cuda::driver::compile::{self, KernelCache};
use crate::backend::cuda::driver::memory::{Budget, Buffer};
use crate::backend::cuda::driver::readback::AsyncReadback;
use cudarc::driver::{CudaContext, CudaEvent, CudaFunction, CudaModule, CudaStream, DeviceRepr, result, sys};
use cudarc::nvrtc::Ptx;
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

/// Oldest driver whose calls are used (stream-ordered allocation, lazy loading): CUDA 12.0.
const OLDEST_DRIVER: i32 = 12_000;

/// How a GPU is used.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GpuSettings {
    /// Most bytes of device memory that ridgewatch takes; none: nine tenths of what is free at start.
    pub memory_cap: Option<u64>,
    /// Where compiled kernels are kept; none: the user's cache folder.
    pub cache: Option<std::path::PathBuf>,
    /// Lowest stream priority, for life beside a solver.
    pub low_priority: bool,
    /// Fills fresh device memory with bytes that make NaN and far indices, so that a kernel that reads what nothing has written shows. For
    /// tests.
    pub poison: bool,
}

/// A device that the driver finds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundDevice {
    /// N of cuda:N.
    pub ordinal: u32,
    /// Marketing name.
    pub name: String,
}

/// One opened GPU. Shared by everything that works on it; all calls may come from any thread.
pub struct Gpu {
    ordinal: u32,
    name: String,
    capability: (i32, i32),
    multiprocessors: u32,
    shared_memory: usize,
    driver_version: i32,
    context: Arc<CudaContext>,
    work: Arc<CudaStream>,
    transfer: Arc<CudaStream>,
    behind: AsyncReadback,
    budget: Arc<Budget>,
    cache: KernelCache,
    /// Or why one does not compile: no frame tries that anew.
    modules: Mutex<HashMap<String, Result<Arc<CudaModule>, DeviceError>>>,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gpu(cuda:{} {})", self.ordinal, self.name)
    }
}

/// Lists the devices, or says why none can be used. Touches no device, allocates nothing, never panics.
pub fn probe() -> Result<Vec<FoundDevice>, DeviceError> {
    // SAFETY: only looks the library up; asked first because cudarc panics where it is absent.
    if !unsafe { sys::is_culib_present() } {
        return Err(DeviceError::NoDriver);
    }
    let start = |error: result::DriverError| DeviceError::DriverStart { reason: format!("{error:?}") };
    result::init().map_err(start)?;
    let found = driver_version()?;
    if found < OLDEST_DRIVER {
        return Err(DeviceError::DriverTooOld { found, needed: OLDEST_DRIVER });
    }
    let count = result::device::get_count().map_err(start)?;
    if count <= 0 {
        return Err(DeviceError::NoDevice);
    }
    // SAFETY: only looks the library up.
    if !unsafe { cudarc::nvrtc::sys::is_culib_present() } {
        return Err(DeviceError::NoNvrtc);
    }
    (0..count)
        .map(|n| {
            let device = result::device::get(n).map_err(start)?;
            Ok(FoundDevice { ordinal: n as u32, name: result::device::get_name(device).map_err(start)? })
        })
        .collect()
}

/// 1000 * major + 10 * minor of the CUDA version that the driver supports. The driver must be there.
fn driver_version() -> Result<i32, DeviceError> {
    let mut version = 0;
    // SAFETY: `version` outlives the call, and `probe` found the library.
    unsafe { sys::cuDriverGetVersion(&mut version) }.result().map_err(DeviceError::driver("asking for the driver's version"))?;
    Ok(version)
}

impl Gpu {
    /// Opens cuda:`ordinal`: its primary context (burn shares it), a stream for work, one for what comes in and one for what goes back.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn open(ordinal: u32, settings: &GpuSettings) -> Result<Arc<Self>, DeviceError> {
        let devices = probe()?;
        let Some(found) = devices.iter().find(|d| d.ordinal == ordinal) else {
            return Err(DeviceError::NoSuchDevice { asked: ordinal, present: devices.len() as u32 });
        };
        let opening = DeviceError::driver("opening the device");
        let context = CudaContext::new(ordinal as usize).map_err(&opening)?;
        let capability = context.compute_capability().map_err(&opening)?;
        if capability < (7, 0) {
            return Err(DeviceError::TooOld { device: ordinal, capability });
        }
        // SAFETY: every use of a buffer on another stream than the one it was made on is ordered by events here (`DeviceSnapshot::ready`,
        // `Buffer::read_by`).
        unsafe { context.disable_event_tracking() };
        let stream = || {
            if settings.low_priority {
                let (least, _) = result::stream::get_priority_range()?;
                context.new_stream_with_priority(least)
            } else {
                context.new_stream()
            }
        };
        let (work, transfer) = (stream().map_err(&opening)?, stream().map_err(&opening)?);
        let behind = AsyncReadback::new(stream().map_err(&opening)?);
        let (free, total) = context.mem_get_info().map_err(&opening)?;
        let attribute = |which| context.attribute(which).map_err(&opening);
        let multiprocessors = attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)? as u32;
        let shared_memory = attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN)? as usize;
        let gpu = Self {
            ordinal,
            name: found.name.clone(),
            capability,
            multiprocessors,
            shared_memory,
            driver_version: driver_version()?,
            work,
            transfer,
            behind,
            budget: Arc::new(Budget::new(settings.memory_cap, free as u64, total as u64).filling(settings.poison.then_some(0xFF))),
            cache: KernelCache::new(settings.cache.clone()),
            modules: Mutex::new(HashMap::new()),
            context,
        };
        gpu.keep_freed_memory()?;
        Ok(Arc::new(gpu))
    }

    /// Freed memory stays in the pool up to the cap: giving it back to the system at each synchronisation costs milliseconds.
    fn keep_freed_memory(&self) -> Result<(), DeviceError> {
        if !self.context.has_async_alloc() {
            return Ok(());
        }
        let doing = DeviceError::driver("setting the memory pool's threshold");
        let mut threshold: u64 = self.budget.cap();
        // SAFETY: the pool is the device's own, the attribute's type is u64, and `threshold` outlives the call.
        unsafe {
            let pool = result::device::get_mem_pool(self.context.cu_device()).map_err(&doing)?;
            let attribute = sys::CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
            result::mem_pool::set_attribute(pool, attribute, (&raw mut threshold).cast()).map_err(&doing)
        }
    }

    /// N of cuda:N.
    pub fn ordinal(&self) -> u32 {
        self.ordinal
    }
    /// Marketing name.
    pub fn name(&self) -> &str {
        &self.name
    }
    /// Compute capability.
    pub fn capability(&self) -> (i32, i32) {
        self.capability
    }
    /// Multiprocessors.
    pub fn multiprocessors(&self) -> u32 {
        self.multiprocessors
    }
    /// Bytes of shared memory that a block may ask for.
    pub fn shared_memory(&self) -> usize {
        self.shared_memory
    }
    /// CUDA version that the driver supports, e.g. `13.0`.
    pub fn driver(&self) -> String {
        format!("{}.{}", self.driver_version / 1000, self.driver_version % 1000 / 10)
    }
    /// The primary context.
    pub fn context(&self) -> &Arc<CudaContext> {
        &self.context
    }
    /// The stream that kernels run on.
    pub fn work(&self) -> &Arc<CudaStream> {
        &self.work
    }
    /// The stream that snapshots come in on.
    pub fn transfer(&self) -> &Arc<CudaStream> {
        &self.transfer
    }
    pub(in crate::backend::cuda) fn behind(&self) -> &AsyncReadback {
        &self.behind
    }
    pub(in crate::backend::cuda) fn budget(&self) -> &Arc<Budget> {
        &self.budget
    }
    /// Bytes taken and bytes that may be taken.
    pub fn memory(&self) -> (u64, u64) {
        (self.budget.used(), self.budget.cap())
    }
    /// Bytes left under the cap.
    pub fn memory_left(&self) -> u64 {
        self.budget.cap().saturating_sub(self.budget.used())
    }

    /// Things that are best worked on together, at so many bytes each: `most`, or as many as a quarter of the memory that is left holds, but at
    /// least 4096.
    pub(in crate::backend::cuda) fn batch(&self, most: usize, bytes: u64) -> usize {
        const SHARE: u64 = 4;
        const LEAST: usize = 1 << 12;
        usize::try_from(self.memory_left() / SHARE / bytes).unwrap_or(most).max(LEAST).min(most)
    }

    /// Memory for `len` values, unset, within the cap. Freed in the order of the work stream.
    ///
    /// # Errors
    /// [`DeviceError::OutOfMemory`] with the numbers.
    pub fn alloc<T: DeviceRepr>(&self, what: &str, len: usize) -> Result<Buffer<T>, DeviceError> {
        Buffer::new(&self.work, &self.budget, what, len)
    }

    /// Copies values to new memory.
    pub fn upload<T: DeviceRepr>(&self, what: &str, values: &[T]) -> Result<Buffer<T>, DeviceError> {
        let mut buffer = self.alloc(what, values.len())?;
        buffer.write(values)?;
        Ok(buffer)
    }

    /// Compiled kernels of one source file (see [`compile::SOURCES`]) with these macros, e.g. `RW_DIMS=3`; compiled once, then from memory,
    /// and from the cache on disk in later runs.
    pub fn module(&self, source: &str, defines: &[String]) -> Result<Arc<CudaModule>, DeviceError> {
        let key = format!("{source} {}", defines.join(" "));
        let mut modules = self.modules.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(module) = modules.get(&key) {
            return module.clone();
        }
        let load = |cubin: Vec<u8>| self.context.load_module(Ptx::from_binary(cubin)).map_err(DeviceError::driver("loading kernels"));
        let request = compile::Request::new(source, self.capability, defines)?;
        let module = match self.cache.find(&request).map(load) {
            Some(Ok(module)) => module,
            Some(Err(error)) if error.is_out_of_memory() => return Err(error),
            // What the driver does not load is as bad as what is not there.
            Some(Err(_)) | None => {
                let cubin = match request.compile() {
                    Ok(cubin) => cubin,
                    Err(error) => {
                        modules.insert(key, Err(error.clone()));
                        return Err(error);
                    }
                };
                self.cache.keep(&request, &cubin);
                load(cubin)?
            }
        };
        modules.insert(key, Ok(module.clone()));
        Ok(module)
    }

    /// One kernel of a source file.
    pub fn kernel(&self, source: &str, defines: &[String], name: &str) -> Result<CudaFunction, DeviceError> {
        self.module(source, defines)?.load_function(name).map_err(DeviceError::driver("finding a kernel"))
    }

    /// Waits until all work so far is done.
    pub fn synchronize(&self) -> Result<(), DeviceError> {
        self.work.synchronize().map_err(DeviceError::driver("waiting for the device"))
    }

    /// A point in the work stream's time, for measurements and for ordering other streams behind it.
    pub fn mark(&self) -> Result<CudaEvent, DeviceError> {
        self.work.record_event(Some(sys::CUevent_flags::CU_EVENT_DEFAULT)).map_err(DeviceError::driver("recording an event"))
    }

    /// Milliseconds of device time between two marks; waits for the second.
    pub fn milliseconds(&self, from: &CudaEvent, to: &CudaEvent) -> Result<f32, DeviceError> {
        from.elapsed_ms(to).map_err(DeviceError::driver("measuring time"))
    }

    /// Top clock of the multiprocessors.
    pub fn top_clock_hz(&self) -> Result<f64, DeviceError> {
        let kilohertz = self.context.attribute(sys::CUdevice_attribute::CU_DEVICE_ATTRIBUTE_CLOCK_RATE);
        Ok(f64::from(kilohertz.map_err(DeviceError::driver("asking for the clock"))?) * 1e3)
    }

    /// Bytes a second that a copy of `bytes` on the device moves, read and written: the ceiling of everything that is bound by memory.
    pub fn copy_rate(&self, bytes: usize) -> Result<f64, DeviceError> {
        let doing = DeviceError::driver("copying on the device");
        let (mut from, to) = (self.alloc::<u8>("a copy", bytes)?, self.alloc::<u8>("a copy", bytes)?);
        from.fill_bytes(0x5a)?;
        let mut best = f32::INFINITY;
        for _ in 0..5 {
            let begin = self.mark()?;
            // SAFETY: both buffers hold `bytes` bytes and do not overlap.
            unsafe { result::memcpy_dtod_async(to.address(), from.address(), bytes, self.work.cu_stream()) }.map_err(&doing)?;
            best = best.min(self.milliseconds(&begin, &self.mark()?)?);
        }
        Ok(2.0 * bytes as f64 / f64::from(best) * 1e3)
    }
}
