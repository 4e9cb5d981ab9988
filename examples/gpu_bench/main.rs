//! Measures the tracing rate of a GPU and its bounds, as blocks of docs/performance.md. Times are medians of device time between events. Seeds and
//! results stay on the device. Every batch is sorted, and the time includes the sort.
//! `cargo run --release --example gpu_bench [quick|collisions|profile]`; `profile` launches each kernel once, for a profiler.

// Prints its results to standard output.
#![allow(clippy::print_stdout)]

#[cfg(not(feature = "cuda"))]
fn main() {
    println!("built without the feature `cuda`");
}

#[cfg(feature = "cuda")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    bench::run(match std::env::args().nth(1).as_deref() {
        None | Some("bench") => bench::Rows::All,
        Some("quick") => bench::Rows::Quick,
        Some("collisions") => bench::Rows::Collisions,
        Some("profile") => bench::Rows::Profile,
        Some(other) => return Err(format!("{other}: bench, quick, collisions or profile").into()),
    })
}

#[cfg(feature = "cuda")]
mod collisions;

#[cfg(feature = "cuda")]
mod bench {
    use super::collisions::Collisions;
    use ridgewatch::backend::Storage;
    use ridgewatch::backend::cuda::{
        Buffer, CudaTracer, DeviceError, DevicePredict, DeviceTable, DeviceTracer, Gpu, GpuSettings, Outputs, SnapshotStore, Tuning,
    };
    use ridgewatch::field::analytic::Analytic;
    use ridgewatch::field::turbulence::Turbulence;
    use ridgewatch::field::{Axis, Domain, DomainPoint, Geometry, Grid, UnitPoint, Window};
    use ridgewatch::flow::{
        Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Traced, VelocitySource,
    };
    use ridgewatch::surrogate::Trace;
    use std::error::Error;
    use std::f64::consts::TAU;
    use std::sync::Arc;
    use std::time::Instant;

    /// Selection of the measurements.
    #[derive(Clone, Copy, PartialEq)]
    pub enum Rows {
        All,
        Quick,
        Collisions,
        Profile,
    }

    const SHAPE: [usize; 3] = [600, 192, 192];
    const SNAPSHOTS: usize = 12;
    const ROUNDS: usize = 7;
    const M: f64 = 1e6;
    const STEPS: [usize; 4] = [6, 11, 22, 110];

    type Outcome<T> = Result<T, Box<dyn Error>>;

    fn map(tau: f64, steps: usize, integrator: Integrator, precision: Precision, difference_step: f64, boundary: Boundary) -> FlowMap {
        FlowMap {
            tau,
            direction: Direction::Forward,
            integrator,
            precision,
            steps: Steps::Fixed(steps),
            difference_step,
            boundary,
            normalisation: Normalisation::Tau,
            interpolation: Interpolation::Linear,
        }
    }

    fn turbulent(steps: usize) -> FlowMap {
        map(SNAPSHOTS as f64 - 1.0, steps, Integrator::Tangent, Precision::F32, 0.05, Boundary::Clamp)
    }

    /// Uniform points in random order.
    fn scattered(domain: &Domain, count: usize, seed: u64) -> Vec<DomainPoint> {
        let mut state = 0x2545_f491_4f6c_dd1du64 ^ (seed << 17);
        let mut uniform = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1u32 << 24) as f32
        };
        (0..count).map(|_| domain.from_unit(UnitPoint([uniform(), uniform(), uniform()]))).collect()
    }

    /// Seeds and results on the device.
    struct Batch {
        seeds: Buffer<[f32; 3]>,
        stretch: Buffer<f32>,
        lifetime_share: Buffer<f32>,
        count: usize,
    }

    impl Batch {
        fn new(gpu: &Gpu, points: &[DomainPoint]) -> Result<Self, DeviceError> {
            Self::of(gpu, gpu.upload("seeds", bytemuck::cast_slice(points))?)
        }

        fn of(gpu: &Gpu, seeds: Buffer<[f32; 3]>) -> Result<Self, DeviceError> {
            let count = seeds.len();
            let mut stretch = gpu.alloc("results", count)?;
            stretch.fill_bytes(0xff)?;
            let mut lifetime_share = gpu.alloc("results", count)?;
            lifetime_share.fill_bytes(0xff)?;
            Ok(Self { seeds, stretch, lifetime_share, count })
        }

        /// Queues a trace of the first `count` seeds.
        fn trace(&self, tracer: &DeviceTracer, count: usize) -> Outcome<()> {
            let out = Outputs { log_stretch: self.stretch.address(), lifetime_share: self.lifetime_share.address(), ..Outputs::default() };
            // SAFETY: all buffers hold `self.count` entries, at least `count`.
            unsafe { tracer.trace(self.seeds.address(), count.min(self.count), &out)? };
            Ok(())
        }

        /// Median milliseconds of a trace of the first `count` seeds.
        fn time(&self, tracer: &DeviceTracer, count: usize) -> Outcome<f64> {
            let gpu = tracer.gpu();
            let mut times = Vec::new();
            for round in 0..=ROUNDS {
                let begin = gpu.mark()?;
                self.trace(tracer, count)?;
                let end = gpu.mark()?;
                let milliseconds = f64::from(gpu.milliseconds(&begin, &end)?);
                // The first round warms up.
                if round > 0 {
                    times.push(milliseconds);
                }
                // Long ones vary little: three do.
                if milliseconds > 400.0 && round > 2 {
                    break;
                }
            }
            times.sort_by(f64::total_cmp);
            Ok(times[times.len() / 2])
        }

        fn stretches(&self) -> Outcome<Vec<f32>> {
            let mut out = vec![0.0; self.count];
            self.stretch.read(&mut out)?;
            Ok(out)
        }

        fn mean_lifetime_share(&self, count: usize) -> Outcome<f64> {
            let mut out = vec![0.0; count];
            self.lifetime_share.read(&mut out)?;
            Ok(out.iter().map(|&l| f64::from(l)).sum::<f64>() / count as f64)
        }
    }

    struct Bench {
        gpu: Arc<Gpu>,
        store: SnapshotStore,
        /// Arithmetic instructions the device issues in a second, all lanes: 4 warps a multiprocessor and cycle at the top clock.
        issue: f64,
        /// Bytes a second of a large copy on the device.
        copy: f64,
    }

    /// Points where the log-stretch is known: traced in f64 with 880 steps.
    struct Truth {
        points: Vec<DomainPoint>,
        batch: Batch,
        log_stretch: Vec<f64>,
        peak: f64,
    }

    impl Truth {
        fn psnr(&self, found: &[f32]) -> f64 {
            let squares: f64 = found.iter().zip(&self.log_stretch).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum();
            10.0 * (self.peak * self.peak / (squares / found.len() as f64)).log10()
        }

        /// Of what a tracer finds there.
        fn psnr_of(&self, tracer: &DeviceTracer) -> Outcome<f64> {
            self.batch.trace(tracer, self.points.len())?;
            Ok(self.psnr(&self.batch.stretches()?))
        }
    }

    impl Bench {
        fn tracer(&self, source: &VelocitySource, map: &FlowMap, tuning: Tuning) -> Outcome<DeviceTracer> {
            let Steps::Fixed(steps) = map.steps else { return Err("a number of steps".into()) };
            Ok(DeviceTracer::new(&self.store, &self.gpu, source, map, 0.0, steps, tuning)?)
        }

        fn truth(&self, source: &VelocitySource, domain: &Domain) -> Outcome<Truth> {
            let fine = FlowMap { precision: Precision::F64, ..turbulent(880) };
            let fine = CudaTracer::new(&self.store, &self.gpu, source.clone(), &fine, 0.0, Tuning::default())?;
            let points = scattered(domain, 1 << 18, 77);
            let mut truth = Traced::default();
            fine.trace(&points, Extras::default(), &mut truth)?;
            let peak = truth.log_stretch_f64.iter().copied().fold(0.0, f64::max);
            Ok(Truth { batch: Batch::new(&self.gpu, &points)?, points, log_stretch: truth.log_stretch_f64, peak })
        }

        fn tables(&self, name: &str, source: &VelocitySource, domain: &Domain, truth: &Truth) -> Outcome<()> {
            let points = &truth.points;
            block(&format!("{name}-steps"));
            println!("| steps | storage | PSNR, dB |\n|---|---|---|");
            let f16 =
                [(6, Storage::F16Pairs), (11, Storage::F16Pairs), (22, Storage::F16), (22, Storage::F16Pairs), (110, Storage::F16Pairs)];
            for (steps, storage) in STEPS.map(|steps| (steps, Storage::F32)).into_iter().chain(f16) {
                let tracer = self.tracer(source, &turbulent(steps), Tuning { storage, ..Tuning::default() })?;
                println!("| {steps} | {} | {:.1} |", storage.name(), truth.psnr_of(&tracer)?);
            }
            block(&format!("{name}-tables"));
            println!(
                "| nodes | traced in, s | M nodes/s | PSNR, dB | lookups in a random order, G/s | coherent lookups, G/s |\n|---|---|---|---|---|---|"
            );
            let tracer = self.tracer(source, &turbulent(22), Tuning::default())?;
            for factor in [1, 2] {
                let nodes = SHAPE.map(|n| factor * (n - 1) + 1);
                let mut table = DeviceTable::trace(&tracer, domain, nodes)?;
                let mut seconds = Vec::new();
                for _ in 0..3 {
                    self.gpu.synchronize()?;
                    let begun = Instant::now();
                    table.retrace(&tracer)?;
                    seconds.push(begun.elapsed().as_secs_f64());
                }
                seconds.sort_by(f64::total_cmp);
                let unit: Vec<UnitPoint> = points.iter().map(|&p| domain.to_unit(p)).collect();
                let asked = self.gpu.upload::<[f32; 3]>("points", bytemuck::cast_slice(&unit))?;
                let answers = self.gpu.alloc::<f32>("answers", unit.len())?;
                // SAFETY: both buffers hold an entry a point.
                unsafe { table.predict(asked.address(), unit.len(), answers.address())? };
                let mut found = vec![0.0; unit.len()];
                answers.read(&mut found)?;
                // Random points, and runs of 32 neighbours a fifth of a cell apart, as along rays of a picture.
                let many = 1usize << 24;
                let cube = Domain::cuboid([0.0; 3], [1.0; 3]);
                let random: Vec<UnitPoint> = scattered(&cube, many, 5).into_iter().map(|p| cube.to_unit(p)).collect();
                let coherent: Vec<UnitPoint> = (0..many)
                    .map(|i| {
                        let (p, lane) = (random[i / 32], (i % 32) as f32);
                        UnitPoint(std::array::from_fn(|k| p.0[k] + lane * [0.2, 0.1, 0.05][k] / SHAPE[k] as f32))
                    })
                    .collect();
                let rate = |points: &[UnitPoint]| -> Outcome<f64> {
                    let asked = self.gpu.upload::<[f32; 3]>("points", bytemuck::cast_slice(points))?;
                    let answers = self.gpu.alloc::<f32>("answers", points.len())?;
                    let mut times = Vec::new();
                    for _ in 0..ROUNDS {
                        let begin = self.gpu.mark()?;
                        // SAFETY: both buffers hold an entry a point.
                        unsafe { table.predict(asked.address(), points.len(), answers.address())? };
                        times.push(f64::from(self.gpu.milliseconds(&begin, &self.gpu.mark()?)?));
                    }
                    times.sort_by(f64::total_cmp);
                    Ok(points.len() as f64 / times[ROUNDS / 2] / 1e6)
                };
                let all = nodes.iter().product::<usize>() as f64;
                println!(
                    "| {nodes:?} | {:.4} | {:.0} | {:.1} | {:.1} | {:.1} |",
                    seconds[1],
                    all / seconds[1] / M,
                    truth.psnr(&found),
                    rate(&random)?,
                    rate(&coherent)?
                );
            }
            Ok(())
        }

        /// The collision points of rays, which no generator of random numbers puts in the same places or order.
        fn collisions(&self, name: &str, source: &VelocitySource) -> Outcome<()> {
            let host = CudaTracer::new(&self.store, &self.gpu, source.clone(), &turbulent(22), 0.0, Tuning::default())?;
            let Collisions { points, first_wave, waves, picture } = Collisions::new(&self.gpu, &host, 1 << 23)?;
            block(&format!("{name}-collisions"));
            println!("{} points in the first wave, {} in {waves}; {} x {} pixels.\n", first_wave, points.len(), picture[0], picture[1]);
            let batch = Batch::of(&self.gpu, points)?;
            self.rows(source, &batch, &KERNELS, &[18, 21, 23])
        }

        /// A line for each kernel and size, a column for each number of steps: millions of samples a second, and the share of the floor.
        fn rows(&self, source: &VelocitySource, batch: &Batch, kernels: &[(&str, Tuning)], sizes: &[u32]) -> Outcome<()> {
            println!("| kernel | seeds | {} |", STEPS.map(|n| format!("{n} steps")).join(" | "));
            println!("|---|---|---|---|---|---|");
            for &(kind, tuning) in kernels {
                let tracers = STEPS.map(|steps| self.tracer(source, &turbulent(steps), tuning));
                for &size in sizes {
                    let count = 1usize << size;
                    if count > batch.count {
                        continue;
                    }
                    let mut line = format!("| {kind} | 2^{size} |");
                    for (steps, tracer) in STEPS.iter().zip(&tracers) {
                        let ms = batch.time(tracer.as_ref().map_err(ToString::to_string)?, count)?;
                        let share = 100.0 * self.floor(*steps, tuning.storage, count) / ms;
                        line += &format!(" {:.0} ({share:.0} %) |", count as f64 / ms / 1e3);
                    }
                    println!("{line}");
                }
            }
            Ok(())
        }

        /// Lower bound of the milliseconds of a trace: the arithmetic of its stages at the device's rate of issue, or one read of the window and the
        /// seeds at the rate of a copy, whichever takes longer.
        fn floor(&self, steps: usize, storage: Storage, count: usize) -> f64 {
            let operations = 4.0 * steps as f64 * STAGE_OPERATIONS * count as f64 / self.issue;
            let node = storage.bytes() as f64;
            // Small batches do not touch it all: 16 nodes a seed and interval at most.
            let nodes = (SHAPE.iter().product::<usize>() * SNAPSHOTS).min(16 * (SNAPSHOTS - 1) * count) as f64;
            let bytes = (node * nodes + 20.0 * count as f64) / self.copy;
            1e3 * operations.max(bytes)
        }

        /// Each kernel once, in the order of [`KERNELS`] and [`STEPS`], for a profiler that looks at the launches of `trace_sorted` and `trace`.
        fn profile(&self, name: &str, flow: &Turbulence) -> Outcome<()> {
            let grid = Turbulence::grid(SHAPE)?;
            let source = VelocitySource::Window(Arc::new(flow.window(&grid, SNAPSHOTS)?));
            let batch = Batch::new(&self.gpu, &scattered(&grid.domain(), 1 << 23, 1))?;
            for (kind, tuning) in KERNELS {
                for steps in STEPS {
                    batch.trace(&self.tracer(&source, &turbulent(steps), tuning)?, batch.count)?;
                    println!("{name}, {kind}, {steps} steps");
                }
            }
            Ok(self.gpu.synchronize()?)
        }

        fn turbulence(&self, name: &str, flow: &Turbulence, rows: Rows) -> Outcome<()> {
            let grid = Turbulence::grid(SHAPE)?;
            let begun = Instant::now();
            let window = Arc::new(flow.window(&grid, SNAPSHOTS)?);
            let made = begun.elapsed().as_secs_f64();
            let source = VelocitySource::Window(window);
            let domain = grid.domain();
            if rows == Rows::Collisions {
                return self.collisions(name, &source);
            }
            let begun = Instant::now();
            let first = self.tracer(&source, &turbulent(22), Tuning::default())?;
            self.gpu.transfer().synchronize()?;
            let (ready, (registers, local)) = (begun.elapsed().as_secs_f64(), first.resources()?);
            block(&format!("{name}-rows"));
            let batch = Batch::new(&self.gpu, &scattered(&domain, 1 << 24, 1))?;
            self.rows(&source, &batch, &KERNELS, if rows == Rows::Quick { &[23] } else { &[18, 21, 23, 24] })?;
            batch.trace(&first, batch.count)?;
            println!(
                "\nShare of steps completed, mean: {:.3}. Made on the CPU in {made:.1} s; on the device, kernels ready, after {ready:.2} s; \
                 {registers} registers and {local} bytes of local memory a thread (cell kept).",
                batch.mean_lifetime_share(1 << 20)?
            );

            let truth = self.truth(&source, &domain)?;
            block(&format!("{name}-differences"));
            println!(
                "| integrator | precision | difference step, cells | window | M samples/s | tangent in f32 is faster by | PSNR, dB |\n|---|---|---|---|---|---|---|"
            );
            let (count, difference_step) = (1 << 23, 1e-4);
            // Integrator, precision, difference step, cell kept, a lane each.
            let rivals = [
                (Integrator::Tangent, Precision::F64, 0.0, false, false),
                (Integrator::Differences, Precision::F32, 0.05, true, true),
                (Integrator::Differences, Precision::F32, 0.05, false, true),
                (Integrator::Differences, Precision::F64, difference_step, false, true),
                (Integrator::Differences, Precision::F32, 0.05, true, false),
                (Integrator::Differences, Precision::F32, 0.05, false, false),
                (Integrator::Differences, Precision::F64, difference_step, false, false),
            ];
            for storage in [Storage::F32, Storage::F16Pairs] {
                let held = Tuning { storage, ..Tuning::default() };
                let tracer = self.tracer(&source, &turbulent(22), held)?;
                let tangent = batch.time(&tracer, count)?;
                let (rate, psnr) = (count as f64 / tangent / 1e3, truth.psnr_of(&tracer)?);
                println!("| tangent | f32 | - | {} | {rate:.0} | 1 | {psnr:.1} |", storage.name());
                // For storage in pairs only the best rivals.
                for &(integrator, precision, difference_step, keep, spread) in
                    &rivals[..if storage == Storage::F32 { rivals.len() } else { 4 }]
                {
                    let changed = FlowMap { integrator, precision, difference_step, ..turbulent(22) };
                    let tracer = self.tracer(&source, &changed, Tuning { keep, spread, ..held })?;
                    let ms = batch.time(&tracer, count)?;
                    let what = if integrator == Integrator::Tangent { "tangent" } else { "six particles" };
                    let how = match (integrator, spread) {
                        (Integrator::Tangent, _) => "",
                        (_, true) => ", a lane each",
                        (_, false) => ", one thread",
                    };
                    let kept = if keep { ", cell kept" } else { "" };
                    let precision = if precision == Precision::F32 { "f32" } else { "f64" };
                    let difference_step = if difference_step > 0.0 { difference_step.to_string() } else { "-".into() };
                    println!(
                        "| {what}{how}{kept} | {precision} | {difference_step} | {} | {:.0} | {:.2} | {:.1} |",
                        storage.name(),
                        count as f64 / ms / 1e3,
                        ms / tangent,
                        truth.psnr_of(&tracer)?
                    );
                }
            }
            let random = KERNELS[2].1;
            let published =
                FlowMap { integrator: Integrator::Differences, precision: Precision::F64, difference_step: 1e-6, ..turbulent(110) };
            let count = 1 << 18;
            let published = self.tracer(&source, &published, random)?;
            let slow = batch.time(&published, count)? / count as f64;
            println!(
                "\nThe published way as it was (six particles in one thread, order as they come, 110 steps, f64, difference step of 1e-6 cells) traces {:.2} M/s at {:.1} dB.",
                1e-3 / slow,
                truth.psnr_of(&published)?
            );
            for (what, tuning) in [
                ("f32", Tuning::default()),
                ("f32 from a window in f16", KERNELS[3].1),
                ("f32 from a window in f16 in pairs", KERNELS[4].1),
            ] {
                let times = [22, 11, 6].map(|steps| -> Outcome<String> {
                    let fast = batch.time(&self.tracer(&source, &turbulent(steps), tuning)?, 1 << 23)? / (1 << 23) as f64;
                    Ok(format!("{:.0} times with {steps} steps", slow / fast))
                });
                let times: Outcome<Vec<String>> = times.into_iter().collect();
                println!("Tangent in {what}, sorted, 2^23 seeds: {}.", times?.join(", "));
            }
            if rows == Rows::All {
                self.collisions(name, &source)?;
            }
            self.tables(name, &source, &domain, &truth)
        }

        /// The whole sphere at one degree with 37 levels, a degree as long as the distance between levels.
        fn levels(&self) -> Outcome<()> {
            block("levels");
            let shape = [360, 181, 37];
            let longitude = Axis::uniform("lon", "degrees_east", 0.0, 359.0, shape[0])?.with_period(360.0);
            let latitude = Axis::uniform("lat", "degrees_north", -90.0, 90.0, shape[1])?;
            let axes = vec![longitude, latitude, Axis::uniform("height", "", 0.0, 36.0, shape[2])?];
            let grid = Arc::new(Grid { axes, geometry: Geometry::Sphere { radius: 1f64.to_degrees() }, slab: (0.0, 1.0) });
            let source = VelocitySource::Window(Arc::new(Turbulence::easy(shape, 0).window(&grid, SNAPSHOTS)?));
            let batch = Batch::new(&self.gpu, &scattered(&grid.domain(), 1 << 23, 1))?;
            println!("| order | steps | M samples/s | registers |\n|---|---|---|---|");
            for (kind, sorted) in [("sorted", true), ("as they come", false)] {
                for steps in [11, 22] {
                    let tracer = self.tracer(&source, &turbulent(steps), Tuning { sorted, ..Tuning::default() })?;
                    let ms = batch.time(&tracer, batch.count)?;
                    println!("| {kind} | {steps} | {:.0} | {} |", batch.count as f64 / ms / 1e3, tracer.resources()?.0);
                }
            }
            Ok(())
        }

        fn gyre(&self) -> Outcome<()> {
            let plane = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
            let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: TAU / 10.0 };
            let source = VelocitySource::Analytic(flow.clone(), plane.clone());
            let batch = Batch::new(&self.gpu, &scattered(&plane, 1 << 24, 3))?;
            block("gyre");
            println!("| integrator | precision | M samples/s | registers |\n|---|---|---|---|");
            for (integrator, precision, difference_step) in [
                (Integrator::Tangent, Precision::F32, 1e-4),
                (Integrator::Tangent, Precision::F64, 1e-4),
                (Integrator::Differences, Precision::F32, 1e-3),
                (Integrator::Differences, Precision::F64, 1e-5),
            ] {
                let tracer =
                    self.tracer(&source, &map(10.0, 100, integrator, precision, difference_step, Boundary::Unbounded), Tuning::default())?;
                let ms = batch.time(&tracer, batch.count)?;
                println!("| {integrator:?} | {precision:?} | {:.0} | {} |", batch.count as f64 / ms / 1e3, tracer.resources()?.0);
            }
            // The same flow on a grid, with cubic interpolation.
            let axis = |name: &str, length: f64, nodes: usize| Axis::uniform(name, "", 0.0, length, nodes);
            let grid =
                Arc::new(Grid { axes: vec![axis("x", 2.0, 401)?, axis("y", 1.0, 201)?], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
            let mut window = Window::new(10.0);
            for t in 0..=20 {
                window.push(Arc::new(flow.snapshot(f64::from(t) * 0.5, &grid)))?;
            }
            let source = VelocitySource::Window(Arc::new(window));
            for interpolation in [Interpolation::Linear, Interpolation::Cubic] {
                for keep in [true, false] {
                    let settings = map(10.0, 100, Integrator::Tangent, Precision::F32, 1e-4, Boundary::Clamp);
                    let tracer = self.tracer(&source, &FlowMap { interpolation, ..settings }, Tuning { keep, ..Tuning::default() })?;
                    let ms = batch.time(&tracer, 1 << 22)?;
                    println!(
                        "| on a grid 401x201x21, {interpolation:?}, {} | F32 | {:.0} | {} |",
                        if keep { "cell kept" } else { "plain" },
                        (1 << 22) as f64 / ms / 1e3,
                        tracer.resources()?.0
                    );
                }
            }
            Ok(())
        }
    }

    /// Arithmetic instructions of one stage of the tangent in three dimensions: interpolation with derivatives 90, location 18, gradient times
    /// tangent 27, stage points and sums 48.
    const STAGE_OPERATIONS: f64 = 183.0;

    const KERNELS: [(&str, Tuning); 5] = {
        let kept = Tuning { storage: Storage::F32, sorted: true, keep: true, spread: true };
        [
            ("cell kept, sorted", kept),
            ("plain, sorted", Tuning { keep: false, ..kept }),
            ("plain, as they come", Tuning { sorted: false, keep: false, spread: false, ..kept }),
            ("cell kept, sorted, f16", Tuning { storage: Storage::F16, ..kept }),
            ("cell kept, sorted, f16 in pairs", Tuning { storage: Storage::F16Pairs, ..kept }),
        ]
    };

    /// Starts a block of docs/performance.md, which ends at the next such line (see scripts/gpu-check-write).
    fn block(name: &str) {
        println!("<!-- block {} -->", name.to_lowercase());
    }

    pub fn run(rows: Rows) -> Outcome<()> {
        let begun = Instant::now();
        let gpu = Gpu::open(0, &GpuSettings::default())?;
        let opened = begun.elapsed().as_secs_f64();
        let clock = gpu.top_clock_hz()?;
        let issue = f64::from(gpu.multiprocessors()) * 128.0 * clock;
        let copy = gpu.copy_rate(1 << 30)?;
        if rows == Rows::All || rows == Rows::Quick {
            block("rates");
            println!(
                "{} multiprocessors at up to {:.0} MHz issue {:.1} T instructions/s over all lanes; a copy of 1 GiB on the device moves {:.2} TB/s, read \
                 and written. Opened in {opened:.2} s.",
                gpu.multiprocessors(),
                clock / M,
                issue / 1e12,
                copy / 1e12
            );
        }
        let bench = Bench { store: SnapshotStore::new(&gpu), gpu, issue, copy };
        if rows == Rows::Profile {
            bench.profile("easy", &Turbulence::easy(SHAPE, 0))?;
            return bench.profile("hard", &Turbulence::hard(SHAPE, 0));
        }
        if rows != Rows::Collisions {
            bench.gyre()?;
            bench.levels()?;
        }
        bench.turbulence("Easy", &Turbulence::easy(SHAPE, 0), rows)?;
        if rows != Rows::Quick {
            bench.turbulence("Hard", &Turbulence::hard(SHAPE, 0), rows)?;
        }
        Ok(())
    }
}
