use super::*;

const GYRE: &str = "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 1]\n[time]\ntau = 10\n";

fn error(text: &str, overrides: &[&str]) -> String {
    let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
    SceneFile::parse(Path::new("scene.toml"), text, &overrides).unwrap_err().to_string()
}

#[test]
fn an_unknown_key_points_at_its_line_and_names_the_nearest() {
    let said = error(&format!("{GYRE}[trust]\ntolerence = 0.1\n"), &[]);
    assert!(said.starts_with("scene.toml:9: "), "{said}");
    assert!(said.contains("Did you mean `tolerance`?"), "{said}");
    assert!(said.contains("   9 | tolerence = 0.1"), "{said}");
}

#[test]
fn a_value_out_of_range_points_at_its_line() {
    let said = error(&format!("{GYRE}[trust]\ntolerance = -1\n"), &[]);
    assert_eq!(said, "scene.toml:9: `trust.tolerance` is -1.0; accepted: a number above 0\n     9 | tolerance = -1");
}

#[test]
fn an_override_is_blamed_for_its_own_faults() {
    assert!(error(GYRE, &["trust.tolerance=-1"]).starts_with("--set trust.tolerance=-1: `trust.tolerance` is -1.0"));
    assert!(error(GYRE, &["trust.tolerence=1"]).contains("Did you mean `tolerance`?"));
    assert!(error(GYRE, &["nonsense"]).contains("accepted: table.key=value"));
    assert!(error(GYRE, &["title.x=1"]).contains("`title` is a value, not a table"));
}

#[test]
fn overrides_take_words_numbers_and_lists() {
    let set = ["flow.boundary=stop", "flow.steps=40", "domain.max=[4, 1, 1]", "time.tau=12.5"].map(str::to_owned);
    let scene = SceneFile::parse(Path::new("s"), GYRE, &set).unwrap();
    assert_eq!(scene.flow.boundary, Some(crate::flow::Boundary::Stop));
    assert_eq!(scene.flow.steps, StepsSetting::Fixed(40));
    assert_eq!(scene.domain.unwrap().max[0], 4.0);
    assert_eq!(scene.time.tau.unwrap().value(), Some(12.5));
}

#[test]
fn spans_have_units() {
    let words = |s: &str| TimeSpan::Words(s.to_owned()).value();
    assert_eq!(words("30 days"), Some(30.0 * 86_400.0));
    assert_eq!(words("1.5h"), Some(5400.0));
    assert_eq!(words("3 fortnights"), None);
    assert_eq!(words("days"), None);
}

#[test]
fn parameters_of_another_flow_are_refused() {
    let said = error(&GYRE.replace("\"double_gyre\"\n", "\"double_gyre\"\nrate = 1\n"), &[]);
    assert!(said.contains("`source.rate` does not belong to kind DoubleGyre"), "{said}");
    assert!(error("[source]\nkind = \"saddle\"\n[time]\ntau = 1\n", &[]).contains("`domain` is missing"));
    assert!(error("[source]\nkind = \"archive\"\n", &[]).contains("`archive.files` is empty"));
}
