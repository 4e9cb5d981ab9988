//! A simulation that runs now, followed on the device: its snapshots come over while frames are made of the ones before.

use super::scenes::*;
use ridgewatch::backend::Device;
use ridgewatch::backend::cuda::GpuSettings;
use ridgewatch::config::SceneFile;
use ridgewatch::field::Grid;
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::publish::compare_films;
use ridgewatch::run::{Frame, RunOptions, Setup};
use ridgewatch::source::live::Live;
use ridgewatch_wire::{AxisDescription, Description, Element, Field, Geometry, Policy, Producer};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

const SHAPE: [usize; 3] = [64, 32, 32];
/// The window holds 9 of them: each has left it before the run ends.
const STEPS: u64 = 24;
const SCENE: &str = "
[source]
kind = \"live\"
[live]
memory_gib = 0.25
follow = \"every\"
at_end = \"stop\"
[time]
tau = 8
snapshots_per_slide = 1
[flow]
steps = 16
boundary = \"clamp\"
[surrogate]
kind = \"table\"
[render]
width = 96
height = 48
samples = 8
";

/// Publishes a turbulence into the ring, a step a snapshot, each when the one before was taken.
fn simulate(ring: &Path, grid: &Grid) {
    let axis = |axis: &ridgewatch::field::Axis| AxisDescription {
        name: axis.name().into(),
        unit: axis.units().into(),
        coordinates: axis.coordinates().to_vec(),
        period: None,
    };
    let description = Description::whole(Geometry::Cartesian, grid.axes.iter().map(axis).collect(), "s");
    let window = Turbulence::easy(SHAPE, 5).window(&Turbulence::grid(SHAPE).unwrap(), STEPS as usize).unwrap();
    let producer = Producer::open(ring, description, 4, Policy::Wait(Duration::from_secs(60))).unwrap();
    for (step, snapshot) in (0..).zip(window.snapshots()) {
        let nodes = snapshot.nodes.as_ptr().cast::<u8>();
        // Components lie side by side, four floats a node.
        let components: [*const u8; 3] = std::array::from_fn(|k| nodes.wrapping_add(4 * k));
        let strides = [4, 4 * SHAPE[0] as isize, 4 * (SHAPE[0] * SHAPE[1]) as isize];
        // SAFETY: a value a node of each component.
        unsafe { producer.publish(step, snapshot.time, &Field { components: &components, element: Element::F32, strides }) }.unwrap();
    }
}

/// Says that a simulation is over however it ended, so that nobody waits for one that never began.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// All frames of following it.
fn followed(device: Device, method: &str) -> Vec<Frame> {
    let folder = tempfile::tempdir_in("/dev/shm").unwrap();
    let ring = folder.path().join("ring");
    let keys = [format!("live.ring=\"{}\"", ring.display()), format!("render.method=\"{method}\"")];
    let scene = SceneFile::parse(Path::new("a test"), SCENE, &keys).unwrap();
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let _over = Over(&over);
            simulate(&ring, &Turbulence::grid(SHAPE).unwrap());
        });
        let live = Live::connect(&scene.live, &over, &mut |_| {}).unwrap().unwrap();
        frames_of(Setup::live(scene.settings(), live).unwrap(), &RunOptions { device, ..RunOptions::default() })
    })
}

#[test]
#[ignore = "needs a GPU"]
fn a_simulation_followed_on_the_device_gives_the_cpu_s_film() {
    for method in ["reference", "gated"] {
        let (found, expected) = (followed(device(GpuSettings::default()), method), followed(Device::CPU, method));
        let steps = |frames: &[Frame]| frames.iter().map(|frame| frame.record.live.as_ref().unwrap().step).collect::<Vec<_>>();
        assert_eq!(steps(&found), (8..STEPS).collect::<Vec<_>>(), "{method}");
        assert_eq!(steps(&expected), steps(&found), "{method}");
        let mut worst = f64::INFINITY;
        for (found, expected) in found.iter().zip(&expected) {
            let (gpu, cpu) = (&found.record, &expected.record);
            assert!(gpu.device.starts_with("cuda:0") && warnings(gpu) == warnings(cpu), "{method}: {:?}, {:?}", gpu.warnings, cpu.warnings);
            assert_eq!(gpu.time, cpu.time);
            let psnr = compare_films(&found.film, &expected.film, found.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
            worst = worst.min(psnr);
            assert!((gpu.traced_share - cpu.traced_share).abs() < 0.05, "{method}: {} and {}", gpu.traced_share, cpu.traced_share);
        }
        measured!("followed live, `{method}`: {} frames, {worst:.1} dB at worst", found.len());
        // As in `answers`: trust at the edge of its tolerance may fall to either side.
        assert!(worst > if method == "gated" { 40.0 } else { 50.0 }, "{method}: {worst} dB");
    }
}
