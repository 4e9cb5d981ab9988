//! Measures the network on a GPU: rates of prediction and training, and its accuracy after some seconds of tracing and training from
//! a new network. Prints blocks of docs/performance.md. `cargo run --release --example gpu_network [speed] [easy] [hard] [realisations] [double-gyre]
//! [abc] [published-speed] [published] [published-double-gyre] [published-globe] [published-flame] [seconds]`
//!
//! Speed: medians of device time between events, random points. Quality: labels are traced on the device at uniform points and stay there. The
//! time includes building the network, tracing (also of the labels that determine the scale) and training; it excludes the upload of the window,
//! the compilation of kernels, and the measurement of the error. PSNR as in docs/accuracy.md: peak is the reference's maximum, 2^20 held-out uniform
//! points, against f64 with 220 steps (1000 for the double gyre, whose points are x, y, the start time and the duration; twice those of the published
//! tracing in `published`). `published` also compares pictures of what was traced, laid out in a table, or learned.

#![allow(clippy::print_stdout)] // a measurement, which prints

#[cfg(not(feature = "cuda"))]
fn main() {
    println!("built without the feature `cuda`");
}

#[cfg(feature = "cuda")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let told: Vec<String> = std::env::args().skip(1).collect();
    let asked = |word: &str| told.is_empty() || told.iter().any(|t| t == word);
    let seconds = told.iter().find_map(|t| t.parse().ok()).unwrap_or(10.0);
    if asked("speed") {
        bench::speed()?;
    }
    for (word, field) in [("easy", bench::Field::Easy), ("hard", bench::Field::Hard)] {
        if asked(word) {
            bench::quality(word, field, seconds)?;
        }
    }
    if asked("realisations") {
        bench::realisations()?;
    }
    if asked("double-gyre") {
        bench::double_gyre(seconds)?;
    }
    if asked("abc") {
        bench::abc(seconds)?;
    }
    if asked("published-speed") {
        bench::published_speed()?;
    }
    for dataset in &bench::DATASETS {
        if asked("published") || told.iter().any(|t| t.strip_prefix("published-") == Some(dataset.name)) {
            bench::published(dataset, seconds)?;
        }
    }
    Ok(())
}

#[cfg(feature = "cuda")]
mod bench {
    use ridgewatch::backend::cuda::{
        Buffer, CudaTracer, DeviceError, DeviceNetwork, DevicePredict, DeviceQueryRouter, DeviceSamples, DeviceTable, DeviceTracer,
        DeviceTraining, FrameQueries, Gpu, GpuRenderer, GpuSettings, NetworkAbove, Outputs, SnapshotStore, Storage, Tuning,
    };
    use ridgewatch::config::SceneFile;
    use ridgewatch::field::Domain;
    use ridgewatch::field::analytic::Analytic;
    use ridgewatch::field::turbulence::Turbulence;
    use ridgewatch::flow::{
        Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, VelocitySource,
    };
    use ridgewatch::publish::compare_films;
    use ridgewatch::render::{Film, Method, RenderStats, Renderer, Scene};
    use ridgewatch::run::{Plan, Setup, Slide, settled_colours};
    use ridgewatch::surrogate::network::{Architecture, Encoding, Input, Model, NetworkSettings, Objective, PlannedStep, Scale, Target};
    use ridgewatch::trust::Gate;
    use std::error::Error;
    use std::path::Path;
    use std::sync::Arc;
    use std::sync::atomic::AtomicBool;
    use std::time::Instant;

    type Outcome<T> = Result<T, Box<dyn Error>>;

    static NEVER: AtomicBool = AtomicBool::new(false);
    const ROUNDS: usize = 9;
    /// Milliseconds from which three rounds are enough.
    const LONG: f64 = 400.0;

    /// Median milliseconds of device time.
    fn time(gpu: &Gpu, mut work: impl FnMut() -> Result<(), DeviceError>) -> Result<f64, DeviceError> {
        let mut times = Vec::new();
        for round in 0..=ROUNDS {
            let begin = gpu.mark()?;
            work()?;
            let milliseconds = f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?);
            // The first round warms up.
            if round > 0 {
                times.push(milliseconds);
            }
            if times.len() == 3 && milliseconds > LONG {
                break;
            }
        }
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }

    fn hash(levels: usize, features: usize, growth: f32, log2_table: u32, width: usize) -> NetworkSettings {
        NetworkSettings {
            levels: Some(levels),
            features,
            growth: Some(growth),
            log2_table: Some(log2_table),
            width,
            ..NetworkSettings::default()
        }
    }

    /// The finest grid, which knows most after some seconds.
    fn finest() -> NetworkSettings {
        NetworkSettings { base_resolution: Some(128), ..hash(4, 4, 1.6, 24, 64) }
    }

    fn step(count: usize, drawn: u64, rate: f64) -> PlannedStep {
        PlannedStep { count, drawn: Some((1, drawn)), hold_out: false, rate, average_share: 0.0, lazy: true }
    }

    pub fn speed() -> Outcome<()> {
        let gpu = Gpu::open(0, &GpuSettings::default())?;
        let cube = Domain::cuboid([0.0; 3], [1.0; 3]);
        println!("<!-- block network-speed -->");
        println!("| network | parameters, M | predicted, G/s | trained, M/s, batch 2^20 | 2^18 | 2^14 |");
        println!("|---|---|---|---|---|---|");
        let frequency =
            |hidden_layers, width| NetworkSettings { encoding: Encoding::Frequency, hidden_layers, width, ..Default::default() };
        for (name, settings) in [
            ("hash 8x2, growth 2, T = 2^19, 2x64", hash(8, 2, 2.0, 19, 64)),
            ("hash 8x2, growth 2, T = 2^22, 2x64", hash(8, 2, 2.0, 22, 64)),
            ("hash 6x4, growth 1.6, T = 2^21, 2x64 (the default)", NetworkSettings::default()),
            (
                "hash 8x2, growth 2, T = 2^19, 2x64, a start time, of one window",
                NetworkSettings { inputs: vec![Input::Start], ..hash(8, 2, 2.0, 19, 64) },
            ),
            ("hash 8x2, growth 2, T = 2^19, 2x64, flow map", NetworkSettings { target: Target::FlowMap, ..hash(8, 2, 2.0, 19, 64) }),
            ("hash 8x2, growth 2, T = 2^19, 2x128", hash(8, 2, 2.0, 19, 128)),
            ("hash 8x2, growth 2, T = 2^19, 2x16", hash(8, 2, 2.0, 19, 16)),
            ("frequency 10, 4x64", frequency(4, 64)),
            ("frequency 10, 2x128", frequency(2, 128)),
        ] {
            let shape = Architecture::new(&settings, &[0, 1, 2], cube.lengths())?;
            let objective = Objective::new(&settings, &shape, cube.extent(), 1.0);
            let parameters = shape.parameters() as f64 * 1e-6;
            let mut training = DeviceTraining::new(&gpu, &Model::new(shape, 1, false), &objective)?;
            let mut points = gpu.alloc("points", 1 << 24)?;
            // Room for arrivals, which are three numbers each.
            let values = gpu.upload("values", &vec![0.5f32; 3 << 24])?;
            let mut pool = training.replay_buffer(1 << 26)?;
            for part in 0..4 {
                training.draw_points(&cube, 3, part << 24, &mut points)?;
                // SAFETY: both buffers hold 2^24 entries or more and outlive the work below.
                unsafe { training.append(&mut pool, &cube, points.address(), values.address(), 1 << 24, None)? };
            }
            let network = training.frozen()?;
            // SAFETY: as above.
            let predicted = time(&gpu, || unsafe { network.predict(points.address(), 1 << 24, values.address()) })?;
            let mut row = format!("| {name} | {parameters:.2} | {:.2} ", (1 << 24) as f64 / predicted * 1e-6);
            for batch in [1 << 20, 1 << 18, 1 << 14] {
                const STEPS: u64 = 16;
                let mut drawn = 0;
                let milliseconds = time(&gpu, || {
                    let steps: Vec<PlannedStep> = (0..STEPS).map(|i| step(batch, drawn + i * batch as u64, 1e-2)).collect();
                    drawn += STEPS * batch as u64;
                    training.train_steps(&pool, None, &steps).map(|_| ())
                })?;
                row += &format!("| {:.0} ", STEPS as f64 * batch as f64 / milliseconds * 1e-3);
            }
            println!("{row}|");
        }
        Ok(())
    }

    #[derive(Clone, Copy)]
    pub enum Field {
        Easy,
        Hard,
    }

    const SHAPE: [usize; 3] = [600, 192, 192];
    const SNAPSHOTS: usize = 12;
    /// Labels traced between two rounds of training, steps of a round, samples of a step, and labels kept.
    const CHUNK: usize = 1 << 21;
    const STEPS: usize = 32;
    const BATCH: usize = 1 << 18;
    const KEPT: usize = 1 << 28;
    const TESTED: usize = 1 << 20;

    fn map(steps: usize, precision: Precision) -> FlowMap {
        FlowMap {
            tau: SNAPSHOTS as f64 - 1.0,
            direction: Direction::Forward,
            integrator: Integrator::Tangent,
            precision,
            steps: Steps::Fixed(steps),
            difference_step: 0.05,
            boundary: Boundary::Clamp,
            normalisation: Normalisation::Tau,
            interpolation: Interpolation::Linear,
        }
    }

    /// Points, and buffers for their values.
    struct Batch {
        points: Buffer<[f32; 3]>,
        values: Buffer<f32>,
    }

    impl Batch {
        fn new(gpu: &Gpu, count: usize) -> Result<Self, DeviceError> {
            Ok(Self { points: gpu.alloc("points", count)?, values: gpu.alloc("values", count)? })
        }

        fn trace(&self, tracer: &DeviceTracer) -> Result<(), DeviceError> {
            let out = Outputs { log_stretch: self.values.address(), ..Outputs::default() };
            // SAFETY: both buffers hold as many entries.
            unsafe { tracer.trace(self.points.address(), self.points.len(), &out) }
        }

        /// Asks something that takes unit coordinates.
        fn ask(&self, surrogate: &dyn DevicePredict) -> Result<(), DeviceError> {
            // SAFETY: both buffers hold as many entries.
            unsafe { surrogate.predict(self.points.address(), self.points.len(), self.values.address()) }
        }

        fn predict(&self, surrogate: &dyn DevicePredict) -> Result<Vec<f32>, DeviceError> {
            self.ask(surrogate)?;
            self.found()
        }

        fn found(&self) -> Result<Vec<f32>, DeviceError> {
            let mut found = vec![0.0; self.values.len()];
            self.values.read(&mut found)?;
            Ok(found)
        }
    }

    /// Points without a velocity have no exact value and do not count.
    fn psnr(found: &[f32], exact: &[f32]) -> f64 {
        let known: Vec<(f32, f32)> = found.iter().copied().zip(exact.iter().copied()).filter(|(_, exact)| exact.is_finite()).collect();
        let peak = known.iter().fold(0.0_f64, |m, &(_, s)| m.max(f64::from(s)));
        let square = known.iter().map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / known.len() as f64;
        20.0 * (peak / square.sqrt()).log10()
    }

    /// Generator of points.
    fn drawer(gpu: &Arc<Gpu>, domain: &Domain) -> Outcome<DeviceTraining> {
        let any = NetworkSettings { log2_table: Some(4), ..NetworkSettings::default() };
        let shape = Architecture::new(&any, &[0, 1, 2], domain.lengths())?;
        let objective = Objective::new(&any, &shape, domain.extent(), 1.0);
        Ok(DeviceTraining::new(gpu, &Model::new(shape, 1, false), &objective)?)
    }

    /// Points where a field is known.
    struct KnownPoints {
        /// Points in domain coordinates, their traced values, and the points in unit coordinates.
        seeds: Batch,
        tested: Batch,
        truth: Vec<f32>,
    }

    impl KnownPoints {
        fn new(gpu: &Arc<Gpu>, domain: &Domain, tracer: &DeviceTracer, exact: &DeviceTracer) -> Outcome<Self> {
            let unit = Domain::cuboid([0.0; 3], [1.0; 3]);
            let drawer = drawer(gpu, domain)?;
            let (mut seeds, mut tested) = (Batch::new(gpu, TESTED)?, Batch::new(gpu, TESTED)?);
            drawer.draw_points(domain, 99, 0, &mut seeds.points)?;
            drawer.draw_points(&unit, 99, 0, &mut tested.points)?;
            seeds.trace(exact)?;
            let truth = seeds.found()?;
            seeds.trace(tracer)?;
            Ok(Self { seeds, tested, truth })
        }
    }

    /// A field with its tracer, and points where it is known.
    struct Known {
        gpu: Arc<Gpu>,
        tracer: CudaTracer,
        domain: Domain,
        steps: usize,
        points: KnownPoints,
    }

    impl Known {
        fn new(field: Field, seed: u64) -> Outcome<Self> {
            let gpu = Gpu::open(0, &GpuSettings::default())?;
            let turbulence = match field {
                Field::Easy => Turbulence::easy(SHAPE, seed),
                Field::Hard => Turbulence::hard(SHAPE, seed),
            };
            let window = Arc::new(turbulence.window(&Turbulence::grid(SHAPE)?, SNAPSHOTS)?);
            let source = VelocitySource::Window(window);
            let store = SnapshotStore::new(&gpu);
            let steps = match field {
                Field::Easy => 22,
                Field::Hard => 44,
            };
            let tracer = CudaTracer::new(&store, &gpu, source.clone(), &map(steps, Precision::F32), 0.0, Tuning::default())?;
            let exact = CudaTracer::new(&store, &gpu, source.clone(), &map(220, Precision::F64), 0.0, Tuning::default())?;
            let domain = tracer.host().domain().clone();
            let points = KnownPoints::new(&gpu, &domain, tracer.device(), exact.device())?;
            Ok(Self { gpu, tracer, domain, steps, points })
        }
    }

    /// Settings of training.
    #[derive(Clone, Copy)]
    struct Pace {
        batch: usize,
        rate: f64,
    }

    const PUBLISHED: Pace = Pace { batch: 1 << 16, rate: 1e-3 };
    const HASH: Pace = Pace { batch: BATCH, rate: 1e-2 };

    /// The published networks.
    fn published_settings() -> impl Iterator<Item = (String, NetworkSettings)> {
        [(8, 256), (8, 512), (16, 256), (16, 512)].into_iter().map(|(hidden_layers, width)| {
            let settings = NetworkSettings { encoding: Encoding::Frequency, hidden_layers, width, ..NetworkSettings::default() };
            (format!("{hidden_layers}x{width}"), settings)
        })
    }

    /// Milliseconds and samples a second.
    struct Rates {
        /// Milliseconds that 2^18 samples are predicted in; samples predicted a second, of 2^22; trained a second, by the batches asked for.
        few: f64,
        predicted: f64,
        trained: Vec<f64>,
    }

    /// 2^18 samples.
    const FEW: usize = 1 << 18;
    const MANY: usize = 1 << 22;

    fn rates(gpu: &Arc<Gpu>, settings: &NetworkSettings, rate: f64, batches: &[usize]) -> Outcome<Rates> {
        let cube = Domain::cuboid([0.0; 3], [1.0; 3]);
        let shape = Architecture::new(settings, &[0, 1, 2], cube.lengths())?;
        let objective = Objective::new(settings, &shape, cube.extent(), 1.0);
        let mut training = DeviceTraining::new(gpu, &Model::new(shape, 1, false), &objective)?;
        let mut points = gpu.alloc("points", MANY)?;
        training.draw_points(&cube, 3, 0, &mut points)?;
        let values = gpu.upload("values", &vec![0.5f32; MANY])?;
        let network = training.frozen()?;
        // SAFETY: both buffers hold `MANY` entries.
        let predicted = |count| time(gpu, || unsafe { network.predict(points.address(), count, values.address()) });
        let (few, many) = (predicted(FEW)?, predicted(MANY)?);
        let mut pool = training.replay_buffer(MANY)?;
        // SAFETY: as above.
        unsafe { training.append(&mut pool, &cube, points.address(), values.address(), MANY, None)? };
        let mut drawn = 0;
        let trained = batches.iter().map(|&batch| {
            const STEPS: u64 = 4;
            let milliseconds = time(gpu, || {
                let steps: Vec<PlannedStep> = (0..STEPS).map(|i| step(batch, drawn + i * batch as u64, rate)).collect();
                drawn += STEPS * batch as u64;
                training.train_steps(&pool, None, &steps).map(|_| ())
            })?;
            Ok(STEPS as f64 * batch as f64 / milliseconds * 1e3)
        });
        let trained = trained.collect::<Result<_, DeviceError>>()?;
        Ok(Rates { few, predicted: MANY as f64 / many * 1e3, trained })
    }

    /// Rates of the published networks; operations are those of their matrix products only.
    pub fn published_speed() -> Outcome<()> {
        let gpu = Gpu::open(0, &GpuSettings::default())?;
        println!("<!-- block network-published-speed -->");
        println!(
            "| network | 2^18 predicted, ms | 2^22 predicted, G/s | TFLOP/s | trained, M/s, batch 2^18 | TFLOP/s | batch 2^16 | 2^14 |"
        );
        println!("|---|---|---|---|---|---|---|---|");
        for (name, settings) in published_settings() {
            let shape = Architecture::new(&settings, &[0, 1, 2], [1.0; 3])?;
            let products: usize = shape.layers.iter().map(|layer| layer.inputs * layer.outputs).sum();
            // Training: forward pass, backward pass without the first layer, and the gradients of the weights.
            let (forward, all) =
                (2e-12 * products as f64, 2e-12 * (3 * products - shape.layers[0].inputs * shape.layers[0].outputs) as f64);
            let Rates { few, predicted, trained } = rates(&gpu, &settings, 1e-3, &[FEW, 1 << 16, 1 << 14])?;
            println!(
                "| {name} | {few:.2} | {:.3} | {:.0} | {:.1} | {:.0} | {:.1} | {:.1} |",
                predicted * 1e-9,
                predicted * forward,
                trained[0] * 1e-6,
                trained[0] * all,
                trained[1] * 1e-6,
                trained[2] * 1e-6
            );
        }
        Ok(())
    }

    /// A dataset of the paper that the published networks are of, or one of its shape.
    pub struct Dataset {
        pub name: &'static str,
        scene: &'static str,
        keys: &'static [&'static str],
        /// Steps of the published tracing.
        steps: usize,
        /// Nodes of tables.
        tables: [[usize; 3]; 2],
    }

    pub const DATASETS: [Dataset; 3] = [
        Dataset {
            name: "double-gyre",
            scene: include_str!("../configs/double_gyre_mcftle.toml"),
            keys: &["flow.steps=auto"],
            steps: 400,
            tables: [[256, 128, 1], [4096, 2048, 1]],
        },
        Dataset {
            name: "globe",
            scene: include_str!("../configs/globe.toml"),
            // At the edges of the published domain particles move on along them.
            keys: &["archive.synthetic.nodes=[360,181,37]", "flow.boundary=clamp"],
            steps: 110,
            tables: [[360, 181, 37], [719, 361, 73]],
        },
        Dataset {
            name: "flame",
            scene: include_str!("../configs/turbulence_easy.toml"),
            keys: &["source.nodes=[600,192,192]"],
            steps: 110,
            tables: [SHAPE, [1199, 383, 383]],
        },
    ];

    /// Pictures of one scene, all with the same random numbers and majorants.
    struct Pictures {
        device: GpuRenderer,
        router: DeviceQueryRouter,
        settled: Renderer,
        samples: u32,
        reference: Arc<Film>,
    }

    impl Pictures {
        fn new(gpu: &Arc<Gpu>, plan: &Plan, slide: &Slide, exact: &CudaTracer) -> Outcome<Self> {
            /// Queries of a picture, about, and most samples a pixel.
            const QUERIES: u64 = 1 << 27;
            const MOST: u64 = 1024;
            let settings = &plan.scene;
            let (camera, light, transfer) = (settings.camera.clone(), settings.light.clone(), settings.transfer.clone());
            let mut scene = Scene::assemble(&plan.domain, camera, light, transfer, settings.render.clone(), settings.seed);
            scene.transfer = settled_colours(plan, exact, slide)?;
            let settled = Renderer::new(scene, &plan.domain, plan.map.tau)?;
            let (device, router) = (GpuRenderer::new(gpu)?, DeviceQueryRouter::new(gpu)?);
            let mut pictures = Self { device, router, settled, samples: 1, reference: Film::default().into() };
            let mut queries = 1;
            for frame in 0..6 {
                let mut renderer = pictures.settled.clone();
                queries = pictures.render(&mut renderer, 1 << 40 | frame, exact, None)?.1.queries;
                pictures.settled = renderer;
            }
            pictures.samples = (QUERIES / queries.max(1)).clamp(16, MOST) as u32;
            let mut renderer = pictures.settled.clone();
            pictures.reference = pictures.render(&mut renderer, 0, exact, None)?.0;
            Ok(pictures)
        }

        /// Answers everything by `surrogate`, or traces everything.
        fn render(
            &mut self,
            renderer: &mut Renderer,
            number: u64,
            tracer: &CudaTracer,
            surrogate: Option<&dyn DevicePredict>,
        ) -> Result<(Arc<Film>, RenderStats), DeviceError> {
            let everywhere = Gate::uniform(true);
            let mut answers = self.router.begin(FrameQueries {
                tracer: tracer.device(),
                domain: tracer.host().domain(),
                missing_cells: tracer.missing_cells(),
                surrogate,
                label_sink: None,
                gate: &everywhere,
                trace_budget: None,
                keep: 0,
                extras: Extras::default(),
            })?;
            self.device.render_samples(renderer, number, 0..self.samples, &mut answers, None, &NEVER)
        }

        /// PSNR and SSIM, as cells of a table.
        fn compared(&mut self, tracer: &CudaTracer, surrogate: Option<&dyn DevicePredict>) -> Outcome<String> {
            let mut renderer = self.settled.clone();
            let (film, _) = self.render(&mut renderer, 0, tracer, surrogate)?;
            let found = compare_films(&film, &self.reference, renderer.scene().settings.tone_map)?;
            Ok(format!("{:.1} | {:.4}", found.psnr.unwrap_or(f64::INFINITY), found.ssim.unwrap_or(f64::NAN)))
        }
    }

    /// A method in the tables of the paper.
    struct Row {
        name: String,
        /// Of what a sample may read; 0 for closed forms.
        megabytes: f64,
        /// Seconds of tracing the table or of training.
        made_in: f64,
        /// Milliseconds for 2^18 and 2^23 samples.
        times: [f64; 2],
        /// PSNR after a second of training.
        early: Option<f64>,
        psnr: f64,
        picture: String,
    }

    /// Milliseconds for 2^18 and 2^23 random points of `domain`.
    fn times(gpu: &Arc<Gpu>, domain: &Domain, answer: impl Fn(&Batch) -> Result<(), DeviceError>) -> Outcome<[f64; 2]> {
        let drawer = drawer(gpu, domain)?;
        let of = |count| -> Outcome<f64> {
            let mut batch = Batch::new(gpu, count)?;
            drawer.draw_points(domain, 3, 0, &mut batch.points)?;
            Ok(time(gpu, || answer(&batch))?)
        };
        Ok([of(FEW)?, of(1 << 23)?])
    }

    /// The tables of the paper, redone on a dataset.
    pub fn published(dataset: &Dataset, seconds: f64) -> Outcome<()> {
        let gpu = Gpu::open(0, &GpuSettings::default())?;
        let unit = Domain::cuboid([0.0; 3], [1.0; 3]);
        let keys: Vec<String> = dataset.keys.iter().map(|&key| key.to_owned()).collect();
        let mut settings = SceneFile::parse(Path::new(dataset.name), dataset.scene, &keys)?.settings();
        settings.render.method = Method::Reference;
        (settings.render.width, settings.render.height) = (320, 160);
        let Setup { plan, mut slides, .. } = Setup::new(settings)?;
        let slide = slides.next_slide(&NEVER)?.ok_or("no slide")?;
        let (domain, store) = (&plan.domain, SnapshotStore::new(&gpu));
        let tracer_of = |map: &FlowMap, tuning| CudaTracer::new(&store, &gpu, slide.velocity.clone(), map, slide.time, tuning);
        let fixed = |steps, precision| FlowMap { steps: Steps::Fixed(steps), precision, ..plan.map.clone() };
        let (ours, pairs) = (Tuning::default(), Tuning { storage: Storage::F16Pairs, ..Tuning::default() });
        let tracer = tracer_of(&plan.map, ours)?;
        let exact = tracer_of(&fixed(2 * dataset.steps, Precision::F64), ours)?;
        let KnownPoints { seeds, tested, truth } = KnownPoints::new(&gpu, domain, tracer.device(), exact.device())?;
        // In single precision: the picture is that of millions of samples.
        let exact = tracer_of(&fixed(2 * dataset.steps, Precision::F32), ours)?;
        let mut pictures = Pictures::new(&gpu, &plan, &slide, &exact)?;
        let nodes = match &slide.velocity {
            VelocitySource::Window(window) => window.grid().map_or(0, |grid| grid.nodes()) * window.snapshots().count(),
            VelocitySource::Analytic(..) => 0,
        };

        let mut rows = Vec::new();
        // The order that the published way traces in is that of its seeds.
        let as_they_come = Tuning { sorted: false, keep: false, spread: false, ..Tuning::default() };
        let particles = FlowMap { integrator: Integrator::Differences, difference_step: 1e-6, ..fixed(dataset.steps, Precision::F64) };
        let (steps, number) = (tracer.host().steps(), 2 * domain.dimensions);
        for (name, map, tuning) in [
            (format!("traced as published: {number} particles, f64, {} steps", dataset.steps), &particles, as_they_come),
            (format!("traced: tangent, f32, {steps} steps"), &plan.map, ours),
            (format!("traced: tangent, f32, {steps} steps, window of f16 in pairs"), &plan.map, pairs),
        ] {
            if nodes == 0 && tuning.storage == Storage::F16Pairs {
                continue;
            }
            let tracer = tracer_of(map, tuning)?;
            let times = times(&gpu, domain, |batch| batch.trace(tracer.device()))?;
            seeds.trace(tracer.device())?;
            // A picture traced in the published way takes as long as all the others.
            let picture = if map == &particles { "- | -".to_owned() } else { pictures.compared(&tracer, None)? };
            let megabytes = 1e-6 * (nodes as u64 * tuning.storage.bytes()) as f64;
            rows.push(Row { name, megabytes, made_in: 0.0, times, early: None, psnr: psnr(&seeds.found()?, &truth), picture });
        }
        let fastest_tracing = rows.iter().map(|row| row.times[1]).fold(f64::INFINITY, f64::min);
        for nodes in dataset.tables {
            let mut table = DeviceTable::trace(tracer.device(), domain, nodes)?;
            let begin = gpu.mark()?;
            table.retrace(tracer.device())?;
            let made_in = f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?) * 1e-3;
            rows.push(Row {
                name: format!("table of {:?} nodes", &nodes[..domain.dimensions]),
                megabytes: 4e-6 * table.nodes().iter().product::<usize>() as f64,
                made_in,
                times: times(&gpu, &unit, |batch| batch.ask(&table))?,
                early: None,
                psnr: psnr(&tested.predict(&table)?, &truth),
                picture: pictures.compared(&tracer, Some(&table))?,
            });
        }
        let hashes =
            [("hash 8x2, growth 2, T = 2^22, 2x64", hash(8, 2, 2.0, 22, 64)), ("hash 4x4, growth 1.6, base 128, T = 2^24, 2x64", finest())];
        let networks = published_settings().map(|(name, settings)| (name, settings, PUBLISHED));
        for (name, settings, pace) in networks.chain(hashes.map(|(name, settings)| (name.to_owned(), settings, HASH))) {
            let lesson = Lesson {
                gpu: &gpu,
                domain,
                labels: &traced_by(tracer.device()),
                axes: &[0, 1, 2][..domain.dimensions],
                parts: 1,
                base: None,
                seconds,
            };
            let (learned, network) = lesson.learn(&settings, pace, |network| Ok(psnr(&tested.predict(&network)?, &truth)))?;
            rows.push(Row {
                name,
                megabytes: learned.megabytes,
                made_in: seconds,
                times: times(&gpu, &unit, |batch| batch.ask(&network))?,
                early: learned.psnr.first().copied(),
                psnr: learned.psnr.last().copied().unwrap_or(f64::NAN),
                picture: pictures.compared(&tracer, Some(&network))?,
            });
        }

        let render = &plan.scene.render;
        println!("<!-- block network-published-{} -->", dataset.name);
        println!(
            "{}. tau {}; pictures of {}x{} pixels, {} samples each.\n",
            plan.source, plan.map.tau, render.width, render.height, pictures.samples
        );
        println!(
            "| | MB | made in, s | 2^18 samples, ms | 2^23 samples, ms | times the published tracing | times our best tracing | \
             PSNR after 1 s, dB | PSNR, dB | picture: PSNR, dB | SSIM |"
        );
        println!("|{}", "---|".repeat(11));
        for Row { name, megabytes, made_in, times: [few, many], early, psnr, picture } in &rows {
            let or_none = |known: bool, text: String| if known { text } else { "-".to_owned() };
            println!(
                "| {name} | {} | {} | {few:.3} | {many:.2} | {:.1} | {:.2} | {} | {psnr:.1} | {picture} |",
                or_none(*megabytes > 0.0, format!("{megabytes:.1}")),
                or_none(*made_in > 0.0, format!("{made_in:.3}")),
                rows[0].times[1] / many,
                fastest_tracing / many,
                early.map_or("-".to_owned(), |psnr| format!("{psnr:.1}"))
            );
        }
        println!();
        Ok(())
    }

    pub fn quality(name: &str, field: Field, seconds: f64) -> Outcome<()> {
        let Known { gpu, tracer, domain, steps, points: KnownPoints { seeds, tested, truth }, .. } = Known::new(field, 0)?;
        println!("<!-- block network-{name} -->");
        println!("Labels, traced with {steps} steps: {:.1} dB. Tables, by their nodes:\n", psnr(&seeds.found()?, &truth));

        let mut table = DeviceTable::trace(tracer.device(), &domain, SHAPE)?;
        let begin = gpu.mark()?;
        table.retrace(tracer.device())?;
        let traced = f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?) * 1e-3;
        println!("| table | MB | traced in, s | PSNR, dB |\n|---|---|---|---|");
        let row = |table: &DeviceTable, seconds: f64| -> Outcome<()> {
            let nodes = table.nodes();
            let megabytes = 4e-6 * nodes.iter().product::<usize>() as f64;
            println!("| {nodes:?} | {megabytes:.0} | {seconds:.3} | {:.1} |", psnr(&tested.predict(table)?, &truth));
            Ok(())
        };
        row(&table, traced)?;
        for nodes in [SHAPE.map(|n| n * 5 / 4), SHAPE.map(|n| 2 * n)] {
            let begin = gpu.mark()?;
            let finer = DeviceTable::trace(tracer.device(), &domain, nodes)?;
            row(&finer, f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?) * 1e-3)?;
        }
        println!();

        println!("| | network | MB | 1 s | 2 s | 5 s | 10 s | labels, M | trained on, M |");
        println!("|---|---|---|---|---|---|---|---|---|");
        let based = |base_resolution, settings| NetworkSettings { base_resolution: Some(base_resolution), ..settings };
        let small = ("6x4, growth 2.2, T = 2^22", hash(6, 4, 2.2, 22, 64));
        let large = ("4x4, growth 1.6, base 128, T = 2^24", finest());
        let alone = [
            ("8x2, growth 2, T = 2^22", hash(8, 2, 2.0, 22, 64)),
            small.clone(),
            ("3x4, growth 1.8, base 128, T = 2^24", based(128, hash(3, 4, 1.8, 24, 64))),
            large.clone(),
        ];
        // A table knows what is coarse: few levels, as many cells as samples can fill, learn the rest sooner.
        let above = [
            small,
            ("3x4, growth 1.7, base 100, T = 2^22", based(100, hash(3, 4, 1.7, 22, 64))),
            ("1x8, base 256, T = 2^22", based(256, hash(1, 8, 1.0, 22, 64))),
            large,
        ];
        for (kind, base, networks) in [("alone", None, alone), ("above the first table", Some(&table), above)] {
            for (name, settings) in networks {
                let base = base.map(|table| (table, traced));
                let lesson = Lesson {
                    gpu: &gpu,
                    domain: &domain,
                    labels: &traced_by(tracer.device()),
                    axes: &[0, 1, 2][..domain.dimensions],
                    parts: 1,
                    base,
                    seconds,
                };
                let (learned, _) = lesson.learn(&settings, HASH, |network| Ok(psnr(&tested.predict(&network)?, &truth)))?;
                println!("| {kind} | {name} | {:.0} {}", learned.megabytes, learned.row());
            }
        }
        println!();
        Ok(())
    }

    /// How much the error of traced labels and of tables differs between realisations of the standard field.
    pub fn realisations() -> Outcome<()> {
        println!("<!-- block network-realisations -->");
        println!("| seed | traced, 22 steps, dB | table of 88 MB, dB | of 707 MB, dB |\n|---|---|---|---|");
        for seed in 0..8 {
            let Known { tracer, domain, points: KnownPoints { seeds, tested, truth }, .. } = Known::new(Field::Easy, seed)?;
            let mut row = format!("| {seed} | {:.1} ", psnr(&seeds.found()?, &truth));
            for nodes in [SHAPE, SHAPE.map(|n| 2 * n)] {
                let table = DeviceTable::trace(tracer.device(), &domain, nodes)?;
                row += &format!("| {:.1} ", psnr(&tested.predict(&table)?, &truth));
            }
            println!("{row}|");
        }
        println!();
        Ok(())
    }

    /// The double gyre over x, y and the start time in [0, 10], tau 10: a network with the start as an input, beside tables with an axis of starts.
    pub fn double_gyre(seconds: f64) -> Outcome<()> {
        const LABEL_STEPS: usize = 100;
        const STARTS: [f64; 2] = [0.0, 10.0];
        let gpu = Gpu::open(0, &GpuSettings::default())?;
        let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: std::f64::consts::TAU / 10.0 };
        let plane = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
        let space_time = Domain::cuboid([0.0, 0.0, STARTS[0]], [2.0, 1.0, STARTS[1]]);
        let map = |steps, precision| FlowMap { precision, ..FlowMap::tangent(10.0, steps) };
        let tracer = DeviceTracer::with_starts(&gpu, &flow, &plane, &map(LABEL_STEPS, Precision::F32), LABEL_STEPS)?;
        let exact = DeviceTracer::with_starts(&gpu, &flow, &plane, &map(1000, Precision::F64), 1000)?;
        let KnownPoints { seeds, tested, truth } = KnownPoints::new(&gpu, &space_time, &tracer, &exact)?;

        println!("<!-- block network-double-gyre -->");
        let mut batch = Batch::new(&gpu, CHUNK)?;
        drawer(&gpu, &space_time)?.draw_points(&space_time, 3, 0, &mut batch.points)?;
        let milliseconds = time(&gpu, || batch.trace(&tracer))?;
        println!(
            "Labels, traced with {LABEL_STEPS} steps, {:.0} M/s: {:.1} dB. Tables over x, y and start, by their nodes:\n",
            CHUNK as f64 / milliseconds * 1e-3,
            psnr(&seeds.found()?, &truth)
        );
        println!("| table | MB | traced in, s | PSNR, dB |\n|---|---|---|---|");
        for nodes in [[272, 136, 136], [384, 192, 192], [512, 256, 256]] {
            let table = DeviceTable::trace(&tracer, &space_time, nodes)?;
            let begin = gpu.mark()?;
            drop(table);
            let table = DeviceTable::trace(&tracer, &space_time, nodes)?;
            let traced = f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?) * 1e-3;
            let megabytes = 4e-6 * nodes.iter().product::<usize>() as f64;
            println!("| {nodes:?} | {megabytes:.0} | {traced:.3} | {:.1} |", psnr(&tested.predict(&table)?, &truth));
        }
        println!();
        println!("| network | MB | 1 s | 2 s | 5 s | 10 s | labels, M | trained on, M |");
        println!("|---|---|---|---|---|---|---|---|");
        let of_start = |settings| NetworkSettings { inputs: vec![Input::Start], start_range: Some(STARTS), ..settings };
        let learned = |name: &str, settings: &NetworkSettings, pace: Pace| -> Outcome<()> {
            let lesson =
                Lesson { gpu: &gpu, domain: &space_time, labels: &traced_by(&tracer), axes: &[0, 1], parts: 1, base: None, seconds };
            let (learned, _) = lesson.learn(settings, pace, |network| Ok(psnr(&tested.predict(&network)?, &truth)))?;
            println!("| {name} | {:.0} {}", learned.megabytes, learned.row());
            Ok(())
        };
        for (name, settings) in [
            ("8x2, growth 2, T = 2^19", hash(8, 2, 2.0, 19, 64)),
            ("8x2, growth 2, T = 2^22", hash(8, 2, 2.0, 22, 64)),
            ("6x4, growth 2.2, T = 2^22", hash(6, 4, 2.2, 22, 64)),
            ("4x4, growth 1.6, base 128, T = 2^24", finest()),
        ] {
            learned(name, &of_start(settings), HASH)?;
        }
        let (name, settings) = published_settings().next().ok_or("no network")?;
        learned(&format!("{name}, frequencies, as published"), &of_start(settings), PUBLISHED)?;
        println!();
        durations(&gpu, &space_time, seconds, |duration, per_unit, precision| {
            let steps = (per_unit * duration).ceil() as usize;
            DeviceTracer::with_starts(&gpu, &flow, &plane, &FlowMap { tau: duration, ..map(steps, precision) }, steps)
        })
    }

    /// The double gyre over x, y, the start time and the duration in (0, 10]: a network of four inputs beside tables of four axes, whose last one is a
    /// row of three-dimensional tables. `tracer` makes a tracer for a duration, with so many steps in a unit of time.
    fn durations(
        gpu: &Arc<Gpu>,
        space_time: &Domain,
        seconds: f64,
        tracer: impl Fn(f64, f64, Precision) -> Result<DeviceTracer, DeviceError>,
    ) -> Outcome<()> {
        const LONGEST: f64 = 10.0;
        const LABELS: f64 = 10.0;
        const TESTS: usize = 32;
        /// Durations of a round of labels.
        const PARTS: usize = 16;
        // A duration from each part of the range, anywhere in it; number by number they fill it evenly (the golden ratio).
        let drawn = |part: usize, parts: usize, number: u64| {
            (part as f64 + (number as f64 * 0.618_033_988_749_895).fract()) / parts as f64 * LONGEST
        };
        let drawer = drawer(gpu, space_time)?;
        let mut tests = Vec::new();
        for test in 0..TESTS {
            let duration = drawn(test, TESTS, test as u64 + 1);
            let (mut seeds, mut tested) = (Batch::new(gpu, TESTED / TESTS)?, Batch::new(gpu, TESTED / TESTS)?);
            drawer.draw_points(space_time, 99, (test * TESTED) as u64, &mut seeds.points)?;
            drawer.draw_points(&Domain::cuboid([0.0; 3], [1.0; 3]), 99, (test * TESTED) as u64, &mut tested.points)?;
            let exact = tracer(duration, 100.0, Precision::F64)?;
            seeds.trace(&exact)?;
            tests.push((duration, tested, seeds.found()?));
        }
        let truth: Vec<f32> = tests.iter().flat_map(|(.., truth)| truth.iter().copied()).collect();

        println!("<!-- block network-durations -->");
        println!("| table over x, y, start and duration | MB | traced in, s | PSNR, dB |\n|---|---|---|---|");
        for n in [22, 34, 54, 76, 108] {
            let nodes = [2 * n, n, n];
            let (mut found, mut traced) = (vec![vec![0.0f32; TESTED / TESTS]; TESTS], 0.0);
            // At the duration 0 the log-stretch is 0.
            for number in 1..n {
                let tracer = tracer(LONGEST * number as f64 / (n - 1) as f64, LABELS, Precision::F32)?;
                let mut table = DeviceTable::trace(&tracer, space_time, nodes)?;
                let begin = gpu.mark()?;
                table.retrace(&tracer)?;
                traced += f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?) * 1e-3;
                for ((duration, tested, _), found) in tests.iter().zip(&mut found) {
                    let weight = 1.0 - (duration / LONGEST * (n - 1) as f64 - number as f64).abs() as f32;
                    if weight > 0.0 {
                        found.iter_mut().zip(tested.predict(&table)?).for_each(|(sum, value)| *sum += weight * value);
                    }
                }
            }
            let megabytes = 4e-6 * (nodes.iter().product::<usize>() * n) as f64;
            println!("| [{}, {n}, {n}, {n}] | {megabytes:.0} | {traced:.3} | {:.1} |", 2 * n, psnr(&found.concat(), &truth));
        }
        println!();

        println!("| network over x, y, start and duration | MB | 1 s | 2 s | 5 s | 10 s | labels, M | trained on, M |");
        println!("|---|---|---|---|---|---|---|---|");
        let labels = |batch: &Batch, number: u64| -> Outcome<Option<[f32; 2]>> {
            let duration = drawn((number % PARTS as u64) as usize, PARTS, number + 1);
            let tracer = tracer(duration, LABELS, Precision::F32)?;
            batch.trace(&tracer)?;
            // The tracer's memory is freed here.
            gpu.synchronize()?;
            Ok(Some([f32::NAN, (duration / LONGEST) as f32]))
        };
        let lesson = Lesson { gpu, domain: space_time, labels: &labels, axes: &[0, 1], parts: PARTS, base: None, seconds };
        let range = Some([space_time.min[2], space_time.max[2]]);
        let frequency = published_settings().map(|(name, settings)| (format!("{name}, frequencies, as published"), settings, PUBLISHED));
        let hashes = [
            ("8x2, growth 1.6, T = 2^16", hash(8, 2, 1.6, 16, 64)),
            ("8x2, growth 2, T = 2^19", hash(8, 2, 2.0, 19, 64)),
            ("8x2, growth 2, T = 2^22", hash(8, 2, 2.0, 22, 64)),
        ];
        let hashes = hashes.into_iter().map(|(name, settings)| (name.to_owned(), settings, HASH));
        for (name, settings, pace) in hashes.chain(frequency.take(1)) {
            let settings = NetworkSettings { inputs: vec![Input::Start, Input::Duration], start_range: range, ..settings };
            let (learned, _) = lesson.learn(&settings, pace, |network| {
                let mut found = Vec::with_capacity(TESTED);
                for (duration, tested, _) in &tests {
                    found.append(&mut tested.predict(&network.at([f32::NAN, (duration / LONGEST) as f32]))?);
                }
                Ok(psnr(&found, &truth))
            })?;
            println!("| {name} | {:.1} {}", learned.megabytes, learned.row());
        }
        println!();
        Ok(())
    }

    /// The unsteady ABC flow over x, y, z, the start time in [0, 2] and the duration in (0, 4]: a network of five inputs beside tables of five axes, which
    /// are three-dimensional tables for each node of start and duration.
    pub fn abc(seconds: f64) -> Outcome<()> {
        const LATEST: f64 = 2.0;
        const LONGEST: f64 = 4.0;
        const LABELS: f64 = 8.0;
        const TESTS: usize = 64;
        const PARTS: usize = 16;
        let gpu = Gpu::open(0, &GpuSettings::default())?;
        let store = SnapshotStore::new(&gpu);
        let flow = Analytic::Abc { a: 3.0_f64.sqrt(), b: 2.0_f64.sqrt(), c: 1.0, growth: 0.5 };
        let domain = Domain::cuboid([0.0; 3], [std::f64::consts::TAU; 3]);
        let source = VelocitySource::Analytic(flow, domain.clone());
        let tracer = |[start, duration]: [f64; 2], per_unit: f64, precision| {
            let steps = (per_unit * duration).ceil().max(1.0) as usize;
            let map = FlowMap { precision, ..FlowMap::tangent(duration, steps) };
            DeviceTracer::new(&store, &gpu, &source, &map, start, steps, Tuning::default())
        };
        // The additive recurrence of the plastic number fills the square of start and duration evenly (Roberts 2018).
        let drawn = |number: u64| [0.754_877_666_246_693, 0.569_840_290_998_053].map(|step| (0.5 + number as f64 * step).fract());
        let times = |[start, duration]: [f64; 2]| [start * LATEST, duration * LONGEST];
        let drawer = drawer(&gpu, &domain)?;
        let mut tests = Vec::new();
        for test in 0..TESTS {
            // Other times than those of the labels.
            let at = drawn((1 << 32) + test as u64);
            let (mut seeds, mut tested) = (Batch::new(&gpu, TESTED / TESTS)?, Batch::new(&gpu, TESTED / TESTS)?);
            drawer.draw_points(&domain, 99, (test * TESTED) as u64, &mut seeds.points)?;
            drawer.draw_points(&Domain::cuboid([0.0; 3], [1.0; 3]), 99, (test * TESTED) as u64, &mut tested.points)?;
            seeds.trace(&tracer(times(at), 64.0, Precision::F64)?)?;
            tests.push((at, tested, seeds.found()?));
        }
        let truth: Vec<f32> = tests.iter().flat_map(|(.., truth)| truth.iter().copied()).collect();

        println!("<!-- block network-five-inputs -->");
        println!("| table over x, y, z, start and duration | MB | traced in, s | PSNR, dB |\n|---|---|---|---|");
        for n in [14, 22, 34, 48] {
            let (mut found, mut traced) = (vec![vec![0.0f32; TESTED / TESTS]; TESTS], 0.0);
            let at = |number: usize| number as f64 / (n - 1) as f64;
            // At the duration 0 the log-stretch is 0.
            for (start, duration) in (0..n).flat_map(|start| (1..n).map(move |duration| (start, duration))) {
                let tracer = tracer(times([at(start), at(duration)]), LABELS, Precision::F32)?;
                let mut table = DeviceTable::trace(&tracer, &domain, [n; 3])?;
                let begin = gpu.mark()?;
                table.retrace(&tracer)?;
                traced += f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?) * 1e-3;
                for ((of, tested, _), found) in tests.iter().zip(&mut found) {
                    let near = |k: usize, number: usize| (1.0 - (of[k] * (n - 1) as f64 - number as f64).abs()).max(0.0);
                    let weight = (near(0, start) * near(1, duration)) as f32;
                    if weight > 0.0 {
                        found.iter_mut().zip(tested.predict(&table)?).for_each(|(sum, value)| *sum += weight * value);
                    }
                }
            }
            println!("| {n}^5 | {:.1} | {traced:.3} | {:.1} |", 4e-6 * (n as f64).powi(5), psnr(&found.concat(), &truth));
        }
        println!();

        println!("| network over x, y, z, start and duration | MB | 1 s | 2 s | 5 s | 10 s | labels, M | trained on, M |");
        println!("|---|---|---|---|---|---|---|---|");
        let labels = |batch: &Batch, number: u64| -> Outcome<Option<[f32; 2]>> {
            let at = drawn(number);
            let tracer = tracer(times(at), LABELS, Precision::F32)?;
            batch.trace(&tracer)?;
            // The tracer's memory is freed here.
            gpu.synchronize()?;
            Ok(Some(at.map(|share| share as f32)))
        };
        let lesson = Lesson { gpu: &gpu, domain: &domain, labels: &labels, axes: &[0, 1, 2], parts: PARTS, base: None, seconds };
        for (name, settings) in published_settings().take(2) {
            let settings = NetworkSettings { inputs: vec![Input::Start, Input::Duration], start_range: Some([0.0, LATEST]), ..settings };
            let (learned, _) = lesson.learn(&settings, PUBLISHED, |network| {
                let mut found = Vec::with_capacity(TESTED);
                for (at, tested, _) in &tests {
                    found.append(&mut tested.predict(&network.at(at.map(|share| share as f32)))?);
                }
                Ok(psnr(&found, &truth))
            })?;
            println!("| {name}, frequencies, as published | {:.1} {}", learned.megabytes, learned.row());
        }
        println!();
        Ok(())
    }

    /// Accuracy of a network after the seconds of [`MARKS`], and its cost.
    struct Learned {
        /// Of what prediction reads.
        megabytes: f64,
        psnr: Vec<f64>,
        labels: u64,
        trained: u64,
    }

    const MARKS: [f64; 4] = [1.0, 2.0, 5.0, 10.0];

    impl Learned {
        /// Cells of a table: PSNR by time, millions of labels traced and of samples trained on.
        fn row(&self) -> String {
            let cell = |i: usize| self.psnr.get(i).map_or("-".to_owned(), |psnr| format!("{psnr:.1}"));
            let cells: Vec<String> = (0..MARKS.len()).map(cell).collect();
            format!("| {} | {:.0} | {:.0} |", cells.join(" | "), self.labels as f64 * 1e-6, self.trained as f64 * 1e-6)
        }
    }

    /// Labels of a batch by a tracer.
    fn traced_by(tracer: &DeviceTracer) -> impl Fn(&Batch, u64) -> Outcome<Option<[f32; 2]>> {
        |batch, _| Ok(batch.trace(tracer).map(|()| None)?)
    }

    /// What a network is trained on, and for how long.
    struct Lesson<'a> {
        gpu: &'a Arc<Gpu>,
        domain: &'a Domain,
        /// Labels the batch with this number; returns its start (NaN: the points carry it in place of z) and its duration as shares of their ranges,
        /// if these are inputs.
        labels: &'a dyn Fn(&Batch, u64) -> Outcome<Option<[f32; 2]>>,
        /// Axes of space.
        axes: &'a [usize],
        /// Batches of a round.
        parts: usize,
        /// The table that the network adds to, and the seconds that it was traced in.
        base: Option<(&'a DeviceTable, f64)>,
        seconds: f64,
    }

    impl Lesson<'_> {
        /// Draws and labels the points of a batch, and appends them.
        fn append(&self, training: &DeviceTraining, to: &mut DeviceSamples, batch: &mut Batch, seed: u64, number: u64) -> Outcome<()> {
            let count = batch.points.len();
            training.draw_points(self.domain, seed, number * count as u64, &mut batch.points)?;
            let times = (self.labels)(batch, number)?;
            let (points, values, base) = (batch.points.address(), batch.values.address(), self.base.map(|(table, _)| table));
            // SAFETY: both buffers hold `count` entries.
            unsafe {
                match times {
                    None => training.append(to, self.domain, points, values, count, base)?,
                    Some(times) => training.append_at(to, self.domain, [points, values], count, times)?,
                }
            }
            Ok(())
        }

        fn learn(
            &self,
            settings: &NetworkSettings,
            pace: Pace,
            measure: impl Fn(NetworkAbove<'_>) -> Outcome<f64>,
        ) -> Outcome<(Learned, DeviceNetwork)> {
            const SCOUTS: usize = 1 << 14;
            let Self { gpu, domain, axes, parts, base, .. } = *self;
            let shape = Architecture::new(settings, axes, domain.lengths())?;
            let mut objective = Objective::new(settings, &shape, domain.extent(), 1.0);
            let (mut chunk, mut scouts) = (Batch::new(gpu, CHUNK / parts)?, Batch::new(gpu, SCOUTS / parts)?);
            // The least network of the same inputs draws the points that tell how large the labels are.
            let least = NetworkSettings { log2_table: Some(4), ..settings.clone() };
            let least = Model::new(Architecture::new(&least, axes, domain.lengths())?, 1, base.is_some());
            let scout = DeviceTraining::new(gpu, &least, &objective)?;
            let mut pool = scout.replay_buffer(SCOUTS)?;
            gpu.synchronize()?;
            let start = Instant::now();
            for number in 0..parts as u64 {
                self.append(&scout, &mut pool, &mut scouts, 5, number)?;
            }
            objective.scale = scale(&pool, base.is_some())?;
            let mut training = DeviceTraining::new(gpu, &Model::new(shape, 1, base.is_some()), &objective)?;
            let mut buffer = training.replay_buffer(KEPT)?;
            gpu.synchronize()?;
            let mut clock = start.elapsed().as_secs_f64() + base.map_or(0.0, |(_, seconds)| seconds);
            drop((scout, pool, scouts));

            let table = base.map(|(table, _)| (table, 1.0));
            let mut learned = Learned { megabytes: 0.0, psnr: Vec::new(), labels: 0, trained: 0 };
            while clock < self.seconds && learned.psnr.len() < MARKS.len() {
                let Learned { labels, trained, psnr, .. } = &mut learned;
                let start = Instant::now();
                let first = *labels / (CHUNK / parts) as u64;
                for number in first..first + parts as u64 {
                    self.append(&training, &mut buffer, &mut chunk, 7, number)?;
                }
                *labels += CHUNK as u64;
                let done = training.steps();
                let steps: Vec<PlannedStep> = (0..STEPS)
                    .map(|i| {
                        // The mean runs over the last tenth of the steps.
                        let number = done + i + 1;
                        let average_share = if number % 8 == 0 { (8.0 / (0.1 * number as f32)).min(1.0) } else { 0.0 };
                        PlannedStep { average_share, ..step(pace.batch, *trained + (i * pace.batch) as u64, pace.rate) }
                    })
                    .collect();
                training.train_steps(&buffer, None, &steps)?;
                *trained += (STEPS * pace.batch) as u64;
                clock += start.elapsed().as_secs_f64();
                if clock >= MARKS[psnr.len()] {
                    psnr.push(measure(training.frozen()?.above(table))?);
                }
            }
            let network = training.frozen()?;
            let table = base.map_or(0, |(table, _)| 4 * table.nodes().iter().product::<usize>());
            learned.megabytes = (network.bytes() + table) as f64 * 1e-6;
            Ok((learned, network))
        }
    }

    /// Mean and deviation of the targets so far; a residual keeps the mean 0.
    fn scale(pool: &DeviceSamples, centred: bool) -> Outcome<Scale> {
        let values = pool.values()?;
        // A further time is before the target, which then begins the second group of four numbers.
        let groups = values.len() / pool.len();
        let targets = || values.as_flattened().chunks_exact(4 * groups).map(|sample| f64::from(sample[groups + 2]));
        let count = pool.len() as f64;
        let mean = if centred { 0.0 } else { targets().sum::<f64>() / count };
        let square = targets().map(|target| (target - mean).powi(2)).sum::<f64>() / count;
        Ok(Scale { mean: [mean as f32; 3], deviation: [square.sqrt() as f32; 3] })
    }
}
