//! The FTLE field of the slide that the run shows, as a file. It is traced beside the run, on few threads, one at a time for all pages.

use super::access::parameter;
use super::pixels::{NO_WINDOW, Pixels, Refusal, Sent, no_field, refused, whole};
use crate::publish::{NewestFrame, SlideField};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::Serialize;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time after which a field is given up for which nobody asks again.
const FORGOTTEN: Duration = Duration::from_secs(15);
/// Share of the processors that trace it; the run and its simulation have the others.
const SHARE: usize = 4;

/// The field that is being traced, or waits to be fetched.
#[derive(Debug, Default)]
pub(super) struct Fields {
    job: Mutex<Option<Arc<Job>>>,
}

#[derive(Debug)]
struct Job {
    slide: u64,
    began: Instant,
    /// Seeds traced, and those in all.
    done: AtomicUsize,
    all: AtomicUsize,
    asked: Mutex<Instant>,
    /// The file, or why there is none. It is kept for all who ask for it, until nobody does.
    made: Mutex<Option<Result<Bytes, Refusal>>>,
}

/// How far a field is.
#[derive(Serialize)]
struct Underway {
    /// `null` while the run reads its next slide, whose field it will be.
    slide: Option<u64>,
    /// Share of the seeds that are traced.
    share: f64,
    /// Seconds left as they have gone so far; `null` before the first seeds.
    seconds_left: Option<f64>,
}

impl Fields {
    fn lock(&self) -> MutexGuard<'_, Option<Arc<Job>>> {
        lock(&self.job)
    }

    /// The job of a slide, which begins if there is none; without a number that of the newest slide. `Ok(None)`: the run reads its next slide.
    ///
    /// # Errors
    /// The slide is not kept, or the field of another one is being traced.
    fn of(self: &Arc<Self>, slide: Option<u64>, newest: &Arc<NewestFrame>) -> Result<Option<Arc<Job>>, Refusal> {
        let slides = newest.slide().ok_or((StatusCode::NOT_FOUND, NO_WINDOW.to_owned()))?;
        let shown = slides.index();
        let mut kept = self.lock();
        match &*kept {
            Some(job) if Some(job.slide) == slide.or(shown) => return Ok(Some(Arc::clone(job))),
            Some(job) if lock(&job.made).is_none() => {
                return Err((
                    StatusCode::SERVICE_UNAVAILABLE,
                    format!("the field of slide {} is being traced: try again later", job.slide),
                ));
            }
            _ => {}
        }
        let Some(field) = slides.get(slide).map_err(no_field)? else {
            return Ok(None);
        };
        let now = Instant::now();
        let [done, all] = [0, 0].map(AtomicUsize::new);
        let job = Arc::new(Job { slide: field.index(), began: now, done, all, asked: Mutex::new(now), made: Mutex::default() });
        *kept = Some(Arc::clone(&job));
        tokio::spawn(Arc::clone(self).make(Arc::clone(&job), field, newest.about().run().to_owned()));
        Ok(Some(job))
    }

    async fn make(self: Arc<Self>, job: Arc<Job>, field: SlideField, run: String) {
        let tracing = Arc::clone(&job);
        let made = tokio::task::spawn_blocking(move || tracing.trace(&field, &run)).await;
        let failed = |error: String| (StatusCode::INTERNAL_SERVER_ERROR, error);
        *lock(&job.made) = Some(made.unwrap_or_else(|error| Err(failed(error.to_string()))).map(Bytes::from));
        while lock(&job.asked).elapsed() < FORGOTTEN {
            tokio::time::sleep(Duration::from_secs(1)).await;
        }
        self.lock().take_if(|kept| Arc::ptr_eq(kept, &job));
    }
}

impl Job {
    fn trace(&self, field: &SlideField, run: &str) -> Result<Vec<u8>, Refusal> {
        let threads = std::thread::available_parallelism().map_or(1, |threads| threads.get().div_ceil(SHARE));
        let failed = |error: rayon::ThreadPoolBuildError| (StatusCode::INTERNAL_SERVER_ERROR, error.to_string());
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|n| format!("ridgewatch-field-{n}")).build();
        pool.map_err(failed)?.install(|| {
            field
                .netcdf(run, &mut |done, all| {
                    self.done.store(done, Ordering::Relaxed);
                    self.all.store(all, Ordering::Relaxed);
                    lock(&self.asked).elapsed() < FORGOTTEN
                })
                .map_err(no_field)
        })
    }

    fn underway(&self) -> Underway {
        let [done, all] = [&self.done, &self.all].map(|count| count.load(Ordering::Relaxed) as f64);
        let share = if all > 0.0 { done / all } else { 0.0 };
        let left = self.began.elapsed().as_secs_f64() * (1.0 - share) / share;
        Underway { slide: Some(self.slide), share, seconds_left: Some(left).filter(|left| left.is_finite()) }
    }
}

impl Pixels {
    /// Answers with the field of a slide as NetCDF, or with how far it is (202): who asks again within seconds gets it in the end.
    pub fn field(&self, uri: &Uri) -> Response {
        self.field_of(uri).unwrap_or_else(refused)
    }

    fn field_of(&self, uri: &Uri) -> Result<Response, Refusal> {
        let newest = &self.newest;
        let accepted = "the number of a slide, or none for the newest";
        let slide = parameter(uri, "slide").map(|text| whole("slide", text, accepted)).transpose()?;
        let Some(job) = self.fields.of(slide, newest)? else {
            return underway(&Underway { slide: None, share: 0.0, seconds_left: None });
        };
        *lock(&job.asked) = Instant::now();
        // Without a place for it the file waits.
        let place = Arc::clone(&self.downloads).try_acquire_owned().ok();
        let made = place.and_then(|place| Some((lock(&job.made).clone()?, place)));
        let Some((made, place)) = made else {
            return underway(&job.underway());
        };
        if made.is_err() {
            self.fields.lock().take_if(|kept| Arc::ptr_eq(kept, &job));
        }
        let name = format!("{}-field-slide-{:04}.nc", newest.about().run(), job.slide);
        let bytes = made.map_err(|(status, why)| (status, format!("{name} cannot be made: {why}")))?;
        let head = [(CONTENT_TYPE, "application/netcdf".to_owned()), (CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\""))];
        Ok((head, Bytes::from_owner(Sent::new(bytes, place))).into_response())
    }
}

fn underway(how_far: &Underway) -> Result<Response, Refusal> {
    let json = serde_json::to_string(how_far).map_err(|error| (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()))?;
    Ok((StatusCode::ACCEPTED, [(CONTENT_TYPE, "application/json")], json).into_response())
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
