//! Films that the device fills and the host shows.

use crate::cuda::driver::pinned::Registered;
use crate::cuda::{DeviceError, Gpu};
use ridgewatch_render::Film;
use std::sync::Arc;

/// Films that are kept: those that subscribers and writers of files usually hold, and one that is filled.
const KEPT: usize = 6;

/// Who fills a film, which decides what its planes are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filled {
    /// The combination of smooth pictures.
    Combined,
    /// Tracked paths.
    Tracked,
}

impl Filled {
    /// Planes of a film that follow its colours in the memory of the device, in their order there.
    pub(super) fn planes(self, film: &mut Film) -> Vec<&mut Vec<f32>> {
        let Film { ftle_mean, traced, variance, samples, missing, queries, error, .. } = film;
        match self {
            Self::Combined => vec![ftle_mean, error, missing, samples, traced],
            Self::Tracked => vec![ftle_mean, traced, missing, queries, samples, variance],
        }
    }

    /// A film with these planes.
    fn blank(self, width: usize, height: usize) -> Film {
        /// Floats of a page, so that no two planes share one, which could be pinned once only.
        const PAGE: usize = 1024;
        fn plane<T: Copy + Default>(pixels: usize) -> Vec<T> {
            let mut values = Vec::with_capacity(pixels + PAGE);
            values.resize(pixels, T::default());
            values
        }
        let mut film = Film { width, height, rgba: plane(width * height), ..Film::default() };
        self.planes(&mut film).into_iter().for_each(|values| *values = plane(width * height));
        film
    }
}

/// A film into which the device writes, pinned unless there are too many.
pub struct PinnedFilm {
    // Unpinned before it can be freed.
    _pins: Vec<Registered>,
    film: Arc<Film>,
    /// Set while copies into the film are under way.
    filling: Option<Arc<Gpu>>,
    /// What those of its planes show that seldom change, as a number of who fills it; 0 at first.
    pub(super) shows: u64,
}

impl PinnedFilm {
    /// A film that is not pinned, into which copies take longer.
    fn unpinned(filled: Filled, width: usize, height: usize) -> Self {
        Self { _pins: Vec::new(), film: Arc::new(filled.blank(width, height)), filling: None, shows: 0 }
    }

    /// A film of this size. Memory that the driver does not pin is written all the same, but more slowly.
    pub fn new(gpu: &Gpu, filled: Filled, width: usize, height: usize) -> Self {
        let mut film = filled.blank(width, height);
        // SAFETY: the pins are dropped before the film, whose planes nobody else can change while this holds it.
        let pin = |values: &mut [f32]| unsafe { Registered::new(gpu.context(), values) };
        let mut pins = vec![pin(film.rgba.as_flattened_mut())];
        pins.extend(filled.planes(&mut film).into_iter().map(|values| pin(values)));
        Self { _pins: pins.into_iter().filter_map(Result::ok).collect(), film: Arc::new(film), filling: None, shows: 0 }
    }

    /// The film.
    pub fn film(&self) -> &Arc<Film> {
        &self.film
    }

    /// The film to be filled; `None` while somebody else holds it.
    pub(super) fn film_mut(&mut self) -> Option<&mut Film> {
        Arc::get_mut(&mut self.film)
    }

    /// Notes that copies into the film are enqueued, which nobody waits for yet.
    pub(super) fn begins(&mut self, gpu: &Arc<Gpu>) {
        self.filling = Some(gpu.clone());
    }

    /// Waits for the copies.
    ///
    /// # Errors
    /// A driver call fails.
    pub(super) fn wait(&mut self, gpu: &Gpu) -> Result<(), DeviceError> {
        gpu.synchronize()?;
        self.filling = None;
        Ok(())
    }
}

impl Drop for PinnedFilm {
    fn drop(&mut self) {
        // The device writes into the memory until then. After a device error it does not any more.
        self.filling.take().into_iter().for_each(|gpu| drop(gpu.synchronize()));
    }
}

/// The latest films. Those that nobody holds any more are filled again, since it takes longer to map and pin memory than to fill it.
pub struct Films {
    filled: Filled,
    kept: Vec<PinnedFilm>,
}

impl Films {
    /// No films yet.
    pub(super) fn new(filled: Filled) -> Self {
        Self { filled, kept: Vec::new() }
    }

    /// A film of this size that nobody else holds. Goes back by [`Self::put`].
    pub(super) fn spare(&mut self, gpu: &Gpu, width: usize, height: usize) -> PinnedFilm {
        self.kept.retain(|kept| [kept.film.width, kept.film.height] == [width, height]);
        if let Some(spare) = self.kept.iter().position(|kept| Arc::strong_count(&kept.film) == 1) {
            return self.kept.swap_remove(spare);
        }
        // Pinning takes longer than a copy into memory that is not.
        let is_kept = self.kept.len() < KEPT;
        if is_kept { PinnedFilm::new(gpu, self.filled, width, height) } else { PinnedFilm::unpinned(self.filled, width, height) }
    }

    /// Keeps a film, and returns it for those who show it.
    pub(super) fn put(&mut self, film: PinnedFilm) -> Arc<Film> {
        let shown = film.film.clone();
        if self.kept.len() < KEPT {
            self.kept.push(film);
        }
        shown
    }
}
