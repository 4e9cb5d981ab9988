//! Traces the nodes of a laid out network on the GPU, brick by brick, where the network is not trusted.

use super::march::{BricksArgument, NodeGrid, variant};
use super::router::DeviceLogStretch;
use crate::TracedBricks;
use crate::cuda::layout::UnitBoxArgument;
use crate::cuda::{Buffer, DeviceError, Gpu, launch, threads};
use cudarc::driver::{CudaFunction, LaunchConfig, PushKernelArg};
use ridgewatch_base::progress;
use ridgewatch_field::Domain;
use ridgewatch_render::Renderer;
use ridgewatch_render::smooth::{brick_shape, own_nodes};
use ridgewatch_trust::Gate;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Bricks that are traced at once: their points, values and marks take at most 200 MB.
const AT_ONCE: usize = 1 << 14;
/// Threads of a block of the kernels.
const BLOCK: u32 = 256;
const WHAT: &str = "nodes of a network that are traced";

/// Traced bricks of a window, in device memory.
pub(super) struct DeviceBricks {
    gpu: Arc<Gpu>,
    points: CudaFunction,
    store: CudaFunction,
    highest: CudaFunction,
    /// The window that they are of.
    window: Option<u64>,
    traced: TracedBricks,
    batches: Vec<Batch>,
}

/// Bricks that were traced together.
struct Batch {
    /// Number of each brick, and of its first node among the values.
    list: Buffer<[u32; 2]>,
    values: Buffer<f32>,
}

/// Where and how many nodes are traced.
pub(super) struct Wanted<'a> {
    /// The window; another one has nothing traced.
    pub(super) window: u64,
    pub(super) domain: &'a Domain,
    pub(super) gate: &'a Gate,
    /// Most nodes.
    pub(super) most: usize,
    /// Setting it ends the tracing early; the frame is then of no use.
    pub(super) stop: &'a AtomicBool,
}

impl DeviceBricks {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub(super) fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("bricks.cu", &[], name);
        Ok(Self {
            points: kernel("brick_points")?,
            store: kernel("brick_store")?,
            highest: gpu.kernel("march.cu", &variant(true, true), "march_bricks")?,
            gpu: gpu.clone(),
            window: None,
            traced: TracedBricks::default(),
            batches: Vec::new(),
        })
    }

    /// Writes the values of traced bricks over those of a network on `nodes`, traces further bricks and writes them too. Returns how many nodes it traced.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub(super) fn fill(
        &mut self,
        nodes: NodeGrid<'_>,
        renderer: &Renderer,
        wanted: &Wanted<'_>,
        answers: &mut dyn DeviceLogStretch,
    ) -> Result<u64, DeviceError> {
        let shape = nodes.shape();
        if self.traced.settle(shape) || self.window != Some(wanted.window) {
            (self.traced, self.batches, self.window) = (TracedBricks::default(), Vec::new(), Some(wanted.window));
            self.traced.settle(shape);
        }
        self.batches.iter().try_for_each(|batch| self.write(nodes, batch))?;
        let next = self.traced.next(&self.largest(nodes)?, wanted.gate, |s| renderer.ramp(s), wanted.most);
        let mut count = 0;
        for bricks in next.chunks(AT_ONCE).take_while(|_| !wanted.stop.load(Ordering::Relaxed)) {
            progress::mark();
            let batch = self.trace(nodes, bricks, wanted.domain, answers)?;
            self.write(nodes, &batch)?;
            count += batch.values.len() as u64;
            self.batches.push(batch);
            self.traced.add(bricks);
        }
        Ok(count)
    }

    /// Share of the nodes that show a network which is not trusted there.
    pub(super) fn untraced_share(&self) -> f64 {
        self.traced.untraced_share()
    }

    /// Largest value of each brick, faces included.
    fn largest(&self, nodes: NodeGrid<'_>) -> Result<Vec<f32>, DeviceError> {
        let count: usize = brick_shape(nodes.shape()).iter().product();
        let highest = self.gpu.alloc::<f32>(WHAT, count)?;
        let (argument, n, address) = (nodes.argument(), count as u32, highest.address());
        let bricks = BricksArgument::of(nodes, address, false);
        let mut call = self.gpu.work().launch_builder(&self.highest);
        call.arg(&argument).arg(&bricks).arg(&n).arg(&address);
        // SAFETY: the arguments of `march_bricks`, a warp a brick; `highest` holds `count` values, and `nodes` borrows its own.
        unsafe { launch(&mut call, threads(count * 32, BLOCK)) }?;
        let mut out = vec![0.0; count];
        highest.read(&mut out)?;
        Ok(out)
    }

    fn trace(
        &self,
        nodes: NodeGrid<'_>,
        bricks: &[u32],
        domain: &Domain,
        answers: &mut dyn DeviceLogStretch,
    ) -> Result<Batch, DeviceError> {
        let mut count = 0;
        let list: Vec<[u32; 2]> = bricks
            .iter()
            .map(|&brick| {
                let first = count as u32;
                count += own_nodes(nodes.shape(), brick as usize).iter().map(ExactSizeIterator::len).product::<usize>();
                [brick, first]
            })
            .collect();
        let batch = Batch { list: self.gpu.upload(WHAT, &list)?, values: self.gpu.alloc(WHAT, count)? };
        let (points, by) = (self.gpu.alloc::<[f32; 3]>(WHAT, count)?, self.gpu.alloc::<u8>(WHAT, count)?);
        let (argument, unit_box) = (nodes.argument(), UnitBoxArgument::new(domain));
        let (from, to) = (batch.list.address(), points.address());
        let mut call = self.gpu.work().launch_builder(&self.points);
        call.arg(&argument).arg(&unit_box).arg(&from).arg(&to);
        // SAFETY: the arguments of `brick_points`, a block a brick; `list` has one entry a block, and `points` room for all nodes that it counts.
        unsafe { launch(&mut call, blocks(list.len())) }?;
        answers.evaluate(to, count, batch.values.address(), by.address())?;
        Ok(batch)
    }

    /// Writes traced values over those of the network.
    fn write(&self, nodes: NodeGrid<'_>, batch: &Batch) -> Result<(), DeviceError> {
        let (argument, list, values) = (nodes.argument(), batch.list.address(), batch.values.address());
        let mut call = self.gpu.work().launch_builder(&self.store);
        call.arg(&argument).arg(&list).arg(&values).arg(&argument.values);
        // SAFETY: the arguments of `brick_store`, a block a brick; `nodes` borrows the values that it writes, which nothing reads meanwhile.
        unsafe { launch(&mut call, blocks(batch.list.len())) }
    }
}

/// A block of threads for each brick.
fn blocks(bricks: usize) -> LaunchConfig {
    LaunchConfig { grid_dim: (bricks as u32, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 }
}
