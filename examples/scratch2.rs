//! scratch: labels <n> <file> | tables | sweep <file> <seconds> key=value...
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs)]
#[path = "../tests/network_support/mod.rs"]
mod support;
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::flow::*;
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::*;
use std::sync::Arc;
fn tracer(steps: usize, precision: Precision) -> Box<dyn Tracer> {
    let shape = [96, 48, 48];
    let window = Turbulence::easy(shape, 0).window(&Turbulence::grid(shape).unwrap(), 12).unwrap();
    let map = FlowMap { tau: 11.0, direction: Direction::Forward, integrator: Integrator::Tangent, precision, steps: Steps::Fixed(steps), gap: 1e-6, boundary: Boundary::Clamp, normalisation: Normalisation::Tau, interpolation: Interpolation::Linear };
    cpu_tracer(VelocitySource::Window(Arc::new(window)), &map, 0.0).unwrap()
}
fn psnr(p: &[f32], t: &[f32]) -> f64 {
    let sq = p.iter().zip(t).map(|(p, t)| f64::from(p - t).powi(2)).sum::<f64>() / p.len() as f64;
    20.0 * (f64::from(t.iter().copied().fold(f32::MIN, f32::max)) / sq.sqrt()).log10()
}
fn held() -> Samples { support::traced(&*tracer(220, Precision::F64), support::uniform_points(1, 1 << 15), false) }
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let n: usize = 1 << 22;
    match a[1].as_str() {
        "labels" => {
            let t = std::time::Instant::now();
            let s = support::traced(&*tracer(22, Precision::F32), support::uniform_points(77, n), false);
            println!("{n} labels in {:?}", t.elapsed());
            let h = held();
            for k in [11, 22, 44] {
                let c = support::traced(&*tracer(k, Precision::F32), h.points.clone(), false);
                println!("{k} steps {:.2} dB", psnr(&c.log_stretch, &h.log_stretch));
            }
            let mut bytes = Vec::new();
            for q in [&h, &s] { for (p, l) in q.points.iter().zip(&q.log_stretch) { for v in p { bytes.extend(v.to_le_bytes()); } bytes.extend(l.to_le_bytes()); } }
            std::fs::write("/tmp/turb.bin", bytes).unwrap();
        }
        "tables" => {
            let h = held();
            let tr = tracer(22, Precision::F32);
            for nodes in [[48, 24, 24], [96, 48, 48], [142, 70, 70], [191, 95, 95], [286, 142, 142]] {
                let t = std::time::Instant::now();
                let table = Table::trace(&*tr, nodes);
                let mut p = vec![0.0; h.len()];
                table.predict(&h.points, &mut p);
                println!("{nodes:?} {} bytes {:.2} dB {:?}", table.bytes(), psnr(&p, &h.log_stretch), t.elapsed());
            }
        }
        _ => {
            let bytes = std::fs::read("/tmp/turb.bin").unwrap();
            let v: Vec<f32> = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            let all: Vec<&[f32]> = v.chunks_exact(4).collect();
            let pool: usize = a[3].parse().unwrap();
            let make = |r: &[&[f32]]| Samples { points: r.iter().map(|q| [q[0], q[1], q[2]]).collect(), log_stretch: r.iter().map(|q| q[3]).collect(), ..Samples::default() };
            let h = make(&all[..1 << 15]);
            let s = make(&all[1 << 15..][..pool]);
            let mut set = toml::Table::new();
            let mut kind = Kind::Network;
            let mut tn = None;
            for x in &a[4..] {
                if x == "residual" { kind = Kind::Residual; continue; }
                if let Some(x) = x.strip_prefix("nodes=") { let k: usize = x.parse().unwrap(); tn = Some([2 * k, k, k]); continue; }
                set.extend(x.parse::<toml::Table>().unwrap());
            }
            let network: NetworkSettings = set.try_into().unwrap();
            let tr = tracer(22, Precision::F32);
            let domain = tr.domain().clone();
            let mut q = build(&SurrogateSettings { kind, table_nodes: tn }, &network, &domain, 0, &*tr).unwrap();
            let samples_total: u64 = a[2].parse().unwrap();
            let t = std::time::Instant::now();
            let mut line = format!("{:?} {} bytes:", &a[3..], q.bytes());
            let steps = (samples_total << 20) / network.batch as u64;
            let mut steps_done = 0;
            for _ in 0..6 {
                let mut p = vec![0.0; h.len()];
                steps_done += q.learn(&s, 1e9, steps / 6).steps;
                q.predict(&h.points, &mut p);
                line += &format!(" {:.2}", psnr(&p, &h.log_stretch));
            }
            println!("{line} ({steps_done} steps, {:.1} s)", t.elapsed().as_secs_f64());
        }
    }
}
