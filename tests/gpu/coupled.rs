//! Coupled paths on the GPU against those of the CPU: the same sums from the same answers, whatever the schedule.

use crate::render::{OnHost, ThroughHost, domain, scene, waves};
use crate::scenes::{gpu, opened};
use ridgewatch::backend::cuda::{
    Buffer, CoupledStats, CoupledTracker, DeviceError, DeviceLogStretch, Gpu, GpuSettings, PairTiles, SUM_PLANES, SurrogateNodes,
};
use ridgewatch::render::Renderer;
use ridgewatch::render::smooth::{Nodes, bayer_rank};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
/// Not multiples of a tile's edge.
const WIDTH: usize = 200;
const HEIGHT: usize = 90;
const TILES: usize = 13 * 6;
const STREAM: u64 = 5;

/// A surrogate near the test field, without missing values.
fn nodes() -> Nodes {
    let shape = [33, 17, 17];
    let value = |index: usize| {
        let unit = Nodes::unit(shape, index);
        let (value, _) = waves([1.7 * unit.0[0], unit.0[1].max(0.31), unit.0[2]]);
        1.05 * value - 0.02
    };
    Nodes::new(shape, Arc::new((0..shape.iter().product()).map(value).collect()))
}

/// Pairs and cursors of a round's tiles, some of them empty, some whole, some beyond the last rank.
fn tiles(round: usize) -> (Vec<u16>, Vec<u16>) {
    let count = |tile: usize| [0, 256, 17, 130, 200, 64][(tile + round) % 6];
    ((0..TILES).map(count).collect(), (0..TILES).map(|tile| (91 * (tile + round) % 256) as u16).collect())
}

fn listed(round: usize) -> Vec<u32> {
    let (pairs, cursors) = tiles(round);
    let all = 0..(WIDTH * HEIGHT) as u32;
    let is_listed = |pixel: &u32| {
        let (x, y) = (pixel % WIDTH as u32, pixel / WIDTH as u32);
        let tile = (y / 16 * 13 + x / 16) as usize;
        u16::from(bayer_rank(x as usize % 16, y as usize % 16).wrapping_sub(cursors[tile] as u8)) < pairs[tile]
    };
    all.filter(is_listed).collect()
}

fn renderer() -> Renderer {
    Renderer::new(scene(WIDTH, HEIGHT, true), &domain(), 1.0).unwrap()
}

/// What a test has on the device.
struct Held {
    values: Buffer<f32>,
    sums: Buffer<f32>,
}

impl Held {
    fn new(gpu: &Gpu) -> Self {
        let values = gpu.upload("nodes", nodes().values()).unwrap();
        let sums = gpu.upload("sums", &vec![0.0; SUM_PLANES * WIDTH * HEIGHT]).unwrap();
        Self { values, sums }
    }

    fn round(
        &mut self,
        tracker: &mut CoupledTracker,
        renderer: &mut Renderer,
        round: usize,
        answers: &mut dyn DeviceLogStretch,
        stop: &AtomicBool,
    ) -> Result<CoupledStats, DeviceError> {
        // What a kernel reads before it has written it would show.
        tracker.poison()?;
        let nodes = SurrogateNodes { values: self.values.address(), shape: nodes().shape(), dimensions: 3 };
        let (pairs, cursors) = tiles(round);
        let tiles = PairTiles { pairs: &pairs, cursors: &cursors };
        // SAFETY: the buffer holds the values of these nodes.
        unsafe { tracker.track(renderer, STREAM, nodes, None, tiles, answers, &mut self.sums, stop) }
    }

    fn sums(&self) -> Vec<f32> {
        let mut sums = vec![0.0; SUM_PLANES * WIDTH * HEIGHT];
        self.sums.read(&mut sums).unwrap();
        sums
    }
}

#[test]
#[ignore = "needs a GPU"]
fn the_same_answers_give_the_cpu_s_sums() {
    let gpu = gpu();
    let (mut cpu, mut on_gpu, mut held) = (renderer(), renderer(), Held::new(&gpu));
    let mut tracker = CoupledTracker::new(&gpu).unwrap();
    let pixels = WIDTH * HEIGHT;
    let mut expected = vec![0.0_f32; SUM_PLANES * pixels];
    for round in 0..4 {
        let list = listed(round);
        let pair = |sums: &[f32], pixel: u32| (sums[12 * pixels + pixel as usize] + sums[13 * pixels + pixel as usize]) as u32;
        let paths: Vec<(u32, u32)> = list.iter().flat_map(|&pixel| [0, 1].map(|half| (pixel, 2 * pair(&expected, pixel) + half))).collect();
        let reference = cpu.coupled_paths(STREAM, &nodes(), None, &paths, &mut OnHost);
        for (&pixel, halves) in list.iter().zip(reference.chunks_exact(2)) {
            let bits = (pixel as usize % WIDTH).count_ones() + (pixel as usize / WIDTH).count_ones();
            let quarter = (pair(&expected, pixel) + bits) as usize & 1;
            let mut add = |plane: usize, value: f32| expected[plane * pixels + pixel as usize] += value;
            for (half, path) in halves.iter().enumerate() {
                (0..3).for_each(|k| add(3 * (2 * half + quarter) + k, path.radiance[k]));
            }
            add(12 + quarter, 1.0);
            add(14, halves[0].alpha + halves[1].alpha);
        }
        let stats = held.round(&mut tracker, &mut on_gpu, round, &mut ThroughHost(&gpu), &NEVER).unwrap();
        let queries: u64 = reference.iter().map(|path| u64::from(path.queries)).sum();
        measured!(
            "coupled, round {round}: {} waves, {} points, {} queries, {queries} on the CPU",
            stats.waves,
            stats.points,
            stats.queries
        );
        assert_eq!((stats.pairs, stats.paths), (list.len() as u64, paths.len() as u64));
        assert!(stats.queries.abs_diff(queries) <= 2 + queries / 1000, "{} queries for {queries}", stats.queries);
        let found = held.sums();
        assert_eq!(found[12 * pixels..14 * pixels], expected[12 * pixels..14 * pixels], "pairs");
        // Rounding turns a decision now and then, as in tracked frames.
        let near = |i: usize| (found[i] - expected[i]).abs() <= 1e-4 * (1.0 + expected[i].abs());
        let odd = (0..pixels).filter(|pixel| !(0..SUM_PLANES).all(|plane| near(plane * pixels + pixel))).count();
        assert!(odd * 200 <= pixels, "{odd} pixels of {pixels} differ");
    }
}

#[test]
#[ignore = "needs a GPU"]
fn schedule_and_memory_leave_every_bit_of_the_sums_alone() {
    let gpu = gpu();
    let run = |mut tracker: CoupledTracker| {
        let (mut renderer, mut held) = (renderer(), Held::new(&gpu));
        (0..3).for_each(|round| assert!(!held.round(&mut tracker, &mut renderer, round, &mut ThroughHost(&gpu), &NEVER).unwrap().stopped));
        held.sums().iter().map(|sum| sum.to_bits()).collect::<Vec<_>>()
    };
    let reference = run(CoupledTracker::new(&gpu).unwrap());
    assert!(run(CoupledTracker::new(&gpu).unwrap()) == reference, "a second run");
    for ahead in [1, 3, 1000] {
        assert!(run(CoupledTracker::new(&gpu).unwrap().with_look_ahead(ahead)) == reference, "looking {ahead} ahead");
    }
    for memory in [2 << 20, 6 << 20] {
        assert!(run(CoupledTracker::new(&gpu).unwrap().with_memory(memory)) == reference, "{memory} bytes");
    }
}

/// Fails in the third wave.
struct Failing<'a>(ThroughHost<'a>, u32);

impl DeviceLogStretch for Failing<'_> {
    fn evaluate(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        self.1 += 1;
        if self.1 > 2 {
            return Err(DeviceError::Unsupported { what: "a third wave".into() });
        }
        self.0.evaluate(points, count, log_stretch, by)
    }
}

#[test]
#[ignore = "needs a GPU"]
fn failed_and_stopped_rounds_leave_the_sums_alone() {
    let gpu = opened(GpuSettings::default());
    let (mut renderer, mut held) = (renderer(), Held::new(&gpu));
    let mut tracker = CoupledTracker::new(&gpu).unwrap().with_look_ahead(1);
    held.round(&mut tracker, &mut renderer, 0, &mut ThroughHost(&gpu), &NEVER).unwrap();
    let before = held.sums();
    let mut failing = Failing(ThroughHost(&gpu), 0);
    assert!(held.round(&mut tracker, &mut renderer, 1, &mut failing, &NEVER).is_err());
    assert!(held.sums() == before);
    assert!(held.round(&mut tracker, &mut renderer, 1, &mut ThroughHost(&gpu), &AtomicBool::new(true)).unwrap().stopped);
    assert!(held.sums() == before);
    held.round(&mut tracker, &mut renderer, 1, &mut ThroughHost(&gpu), &NEVER).unwrap();
    assert!(held.sums() != before);
}
