//! Python module of [`ridgewatch_wire::Producer`]. Arrays are read through the buffer protocol, without a copy.
//!
//! Errors of the ring (a name in use, no room, another user's folder, a time that is not finite) must not end the solver: they are warnings, and exceptions only
//! with `strict`. Wrong shapes and types are always exceptions.

use pyo3::buffer::{Element as BufferElement, PyBuffer};
use pyo3::exceptions::{PyException, PyRuntimeWarning, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use ridgewatch_wire::{AxisDescription, BlockExtent, Description, Element, Field, Geometry, Policy, Producer, ring_from_environment};
use std::ffi::CString;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

pyo3::create_exception!(_core, RidgewatchError, PyException, "The ring could not be opened, or a step was refused.");

/// Reports an error of the ring: an exception if `strict`, otherwise a `RuntimeWarning` (which the program's filters may turn into an exception).
fn refused<T>(py: Python<'_>, strict: bool, what: &str, error: &ridgewatch_wire::WireError) -> PyResult<Option<T>> {
    if strict {
        return Err(RidgewatchError::new_err(error.to_string()));
    }
    // A C string has no zero byte.
    let words = CString::new(format!("ridgewatch: {what}: {error}").replace('\0', "?"))?;
    PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &words, 1)?;
    Ok(None)
}

/// Publishes into a ring. Frozen, so that other threads may call any method while one copies a step.
#[pyclass(frozen)]
struct Publisher {
    /// `None` if publishing is off or closed. The ring ends with the last call that still publishes.
    producer: Mutex<Option<Arc<Producer>>>,
    dimensions: usize,
    reversed: bool,
    strict: bool,
    published: AtomicU64,
    overwrote: AtomicU64,
}

impl Publisher {
    fn producer(&self) -> MutexGuard<'_, Option<Arc<Producer>>> {
        self.producer.lock().unwrap_or_else(|broken| broken.into_inner())
    }
}

/// Memory layout of one component.
struct Array {
    /// Address as a number, which is `Send`: other threads may run while the array is read.
    address: usize,
    element: Element,
    /// Strides in elements along x, y, z.
    strides: [isize; 3],
    /// Nodes along x, y, z.
    shape: [u64; 3],
    /// Keeps the array at its address.
    _buffer: Held,
}

/// True if a buffer's values have the byte order of another machine. `PyBuffer` does not tell (pyo3 0.26 takes the order `>` for that of every machine).
fn is_foreign<T: BufferElement>(buffer: &PyBuffer<T>) -> bool {
    let foreign: &[u8] = if cfg!(target_endian = "little") { b">!" } else { b"<" };
    buffer.format().to_bytes().first().is_some_and(|order| foreign.contains(order))
}

/// A floating-point array in this machine's byte order, with NaN at masked values: a masked array's buffer has what lies under the mask, and arrays from
/// NetCDF and FITS files are big-endian. Any other object is returned as it is.
fn plain<'py>(given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let Ok(dtype) = given.getattr("dtype") else { return Ok(given.clone()) };
    // Not so the types of other libraries.
    if !dtype.getattr("kind").and_then(|kind| kind.extract::<String>()).is_ok_and(|kind| kind == "f") {
        return Ok(given.clone());
    }
    // Only masked arrays have it. Without masked values it copies nothing.
    let filled = match given.getattr_opt("filled")? {
        Some(filled) => filled.call1((f64::NAN,))?,
        None => given.clone(),
    };
    if dtype.getattr("isnative")?.is_truthy()? {
        return Ok(filled);
    }
    filled.call_method1("astype", (dtype.call_method1("newbyteorder", ("=",))?,))
}

/// [`plain`] components. Once one of them is a copy, all are packed, so that they still have one layout.
fn plain_components<'py>(py: Python<'py>, given: &[&Bound<'py, PyAny>]) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let plain = given.iter().map(|array| plain(array)).collect::<PyResult<Vec<_>>>()?;
    if plain.iter().zip(given).all(|(plain, given)| plain.is(*given)) {
        return Ok(plain);
    }
    let packed = |array: &Bound<'py, PyAny>| {
        let Ok(dtype) = array.getattr("dtype") else { return Ok(array.clone()) };
        let how = PyDict::new(py);
        how.set_item("order", "C")?;
        how.set_item("copy", false)?;
        array.call_method("astype", (dtype,), Some(&how))
    };
    plain.iter().map(packed).collect()
}

enum Held {
    #[allow(dead_code)]
    F32(PyBuffer<f32>),
    #[allow(dead_code)]
    F64(PyBuffer<f64>),
}

impl Array {
    fn of<T: BufferElement>(
        buffer: PyBuffer<T>,
        element: Element,
        reversed: bool,
        held: impl FnOnce(PyBuffer<T>) -> Held,
    ) -> PyResult<Self> {
        let count = buffer.dimensions();
        if !(2..=3).contains(&count) {
            return Err(PyValueError::new_err(format!("an array of {count} dimensions; accepted: 2 or 3")));
        }
        let (mut shape, mut strides) = ([1; 3], [0; 3]);
        for k in 0..count {
            let axis = if reversed { count - 1 - k } else { k };
            shape[k] = buffer.shape()[axis] as u64;
            let bytes = buffer.strides()[axis];
            if bytes % size_of::<T>() as isize != 0 {
                let found =
                    format!("an array with a stride of {bytes} bytes; accepted: whole numbers of its elements of {} bytes", size_of::<T>());
                return Err(PyValueError::new_err(found));
            }
            strides[k] = bytes / size_of::<T>() as isize;
        }
        Ok(Self { address: buffer.buf_ptr() as usize, element, strides, shape, _buffer: held(buffer) })
    }

    fn new(given: &Bound<'_, PyAny>, reversed: bool) -> PyResult<Self> {
        if let Ok(buffer) = PyBuffer::<f32>::get(given)
            && !is_foreign(&buffer)
        {
            return Self::of(buffer, Element::F32, reversed, Held::F32);
        }
        if let Ok(buffer) = PyBuffer::<f64>::get(given)
            && !is_foreign(&buffer)
        {
            return Self::of(buffer, Element::F64, reversed, Held::F64);
        }
        let found = match given.getattr("dtype") {
            Ok(dtype) => format!("an array of {dtype}"),
            Err(_) => format!("an object of type {}", given.get_type().name()?),
        };
        Err(PyTypeError::new_err(format!("{found}; accepted: NumPy arrays of float32 or float64")))
    }
}

fn coordinates(given: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let given = &plain(given)?;
    if let Ok(buffer) = PyBuffer::<f64>::get(given)
        && !is_foreign(&buffer)
    {
        return buffer.to_vec(given.py());
    }
    given.try_iter()?.map(|item| item?.extract::<f64>()).collect()
}

#[pymethods]
impl Publisher {
    #[new]
    #[pyo3(signature = (x, y, z=None, *, ring=None, periods=None, radius=None, block=None, start=0, slots=4, wait_ms=0, time_unit="s", order="zyx", strict=false))]
    // The arguments are Python's keyword arguments.
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        x: &Bound<'_, PyAny>,
        y: &Bound<'_, PyAny>,
        z: Option<&Bound<'_, PyAny>>,
        ring: Option<PathBuf>,
        periods: Option<Vec<Option<f64>>>,
        radius: Option<f64>,
        block: Option<(u32, u32, Vec<u64>, Vec<u64>)>,
        start: u64,
        slots: u32,
        wait_ms: u64,
        time_unit: &str,
        order: &str,
        strict: bool,
    ) -> PyResult<Self> {
        let reversed = match order {
            "zyx" => true,
            "xyz" => false,
            other => return Err(PyValueError::new_err(format!("order {other:?}; accepted: \"zyx\", \"xyz\""))),
        };
        let given: Vec<&Bound<'_, PyAny>> = [Some(x), Some(y), z].into_iter().flatten().collect();
        let mut axes = Vec::new();
        for (name, given) in ["x", "y", "z"].into_iter().zip(&given) {
            axes.push(AxisDescription { name: name.into(), unit: String::new(), coordinates: coordinates(given)?, period: None });
        }
        if let Some(periods) = periods {
            if periods.len() != axes.len() {
                return Err(PyValueError::new_err(format!("{} periods; accepted: {}, one per axis", periods.len(), axes.len())));
            }
            axes.iter_mut().zip(periods).for_each(|(axis, period)| axis.period = period);
        }
        let dimensions = axes.len();
        let geometry = radius.map_or(Geometry::Cartesian, |radius| Geometry::Sphere { radius });
        let mut description = Description { start, ..Description::whole(geometry, axes, time_unit) };
        if let Some((index, count, offset, extent)) = block {
            if offset.len() != dimensions || extent.len() != dimensions {
                let found = format!("a block of {} offsets and {} extents", offset.len(), extent.len());
                return Err(PyValueError::new_err(format!("{found}; accepted: {dimensions} of both, one per axis")));
            }
            let of = |numbers: &[u64], beyond| std::array::from_fn(|k| numbers.get(k).copied().unwrap_or(beyond));
            description.block = BlockExtent { index, count, offset: of(&offset, 0), extent: of(&extent, 1) };
        }
        let policy = if wait_ms == 0 { Policy::NewestWins } else { Policy::Wait(Duration::from_millis(wait_ms)) };
        let producer = match ring.or_else(ring_from_environment) {
            // Opening may wait for a name.
            Some(ring) => match py.detach(|| Producer::open(&ring, description, slots, policy)) {
                Ok(producer) => Some(Arc::new(producer)),
                Err(error) => refused(py, strict, "nothing will be published", &error)?,
            },
            None => None,
        };
        let (published, overwrote) = (AtomicU64::new(0), AtomicU64::new(0));
        Ok(Self { producer: Mutex::new(producer), dimensions, reversed, strict, published, overwrote })
    }

    #[pyo3(signature = (step, time, u, v, w=None))]
    fn publish(
        &self,
        py: Python<'_>,
        step: u64,
        time: f64,
        u: &Bound<'_, PyAny>,
        v: &Bound<'_, PyAny>,
        w: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<bool> {
        let Some(producer) = self.producer().clone() else { return Ok(false) };
        let given: Vec<&Bound<'_, PyAny>> = [Some(u), Some(v), w].into_iter().flatten().collect();
        if given.len() != self.dimensions {
            return Err(PyValueError::new_err(format!("{} components; accepted: {}, one per axis", given.len(), self.dimensions)));
        }
        let given = plain_components(py, &given)?;
        let arrays = given.iter().map(|array| Array::new(array, self.reversed)).collect::<PyResult<Vec<_>>>()?;
        let (extent, first) = (producer.description().block.extent, &arrays[0]);
        for (name, array) in ["u", "v", "w"].into_iter().zip(&arrays) {
            if array.shape != extent {
                return Err(PyValueError::new_err(format!("an array of {:?} nodes along x, y, z; accepted: {extent:?}", array.shape)));
            }
            if array.strides != first.strides || array.element != first.element {
                let dtype = |array: &Array| if array.element == Element::F32 { "float32" } else { "float64" };
                let of = |array: &Array| format!("{} with strides {:?}", dtype(array), &array.strides[..self.dimensions]);
                let found = format!("components that differ: {name} is {}", of(array));
                return Err(PyValueError::new_err(format!("{found}; accepted: that of u, {}", of(first))));
            }
        }
        let (addresses, element, strides): (Vec<usize>, _, _) = (arrays.iter().map(|a| a.address).collect(), first.element, first.strides);
        // The buffers are held, so the arrays keep their addresses while other Python threads run.
        let published = py.detach(|| {
            let components: Vec<*const u8> = addresses.iter().map(|address| *address as *const u8).collect();
            // SAFETY: the buffers' shapes and strides were checked against the block's extent.
            let published = unsafe { producer.publish(step, time, &Field { components: &components, element, strides }) };
            // If `close` was called meanwhile, the ring ends here, while other Python threads run.
            drop(producer);
            published
        });
        let published = match published {
            Ok(published) => published,
            Err(error) => return refused::<()>(py, self.strict, "a step was not published", &error).map(|_| false),
        };
        self.published.fetch_max(published.count, Ordering::Relaxed);
        self.overwrote.fetch_add(u64::from(published.overwrote), Ordering::Relaxed);
        Ok(true)
    }

    fn close(&self, py: Python<'_>) {
        let producer = self.producer().take();
        // Closing may wait for a follower that leaves.
        py.detach(|| drop(producer));
    }

    #[getter]
    fn is_open(&self) -> bool {
        self.producer().is_some()
    }

    #[getter]
    fn published(&self) -> u64 {
        self.published.load(Ordering::Relaxed)
    }

    #[getter]
    fn overwrote(&self) -> u64 {
        self.overwrote.load(Ordering::Relaxed)
    }

    fn __enter__(this: Py<Self>) -> Py<Self> {
        this
    }

    #[pyo3(signature = (*arguments))]
    fn __exit__(&self, arguments: &Bound<'_, pyo3::types::PyTuple>) {
        self.close(arguments.py());
    }
}

#[pymodule]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Publisher>()?;
    module.add("RidgewatchError", module.py().get_type::<RidgewatchError>())
}
