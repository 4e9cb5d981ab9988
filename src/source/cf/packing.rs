//! Packed and missing values: `scale_factor`, `add_offset`, `_FillValue`, `missing_value`, `valid_range`, `_Unsigned`
//! (CF conventions, section 8.1; NetCDF User's Guide, appendix A).

use crate::formats::{Attribute, NumberType, Variable};

/// Conversion of raw numbers to values; missing ones become NaN.
#[derive(Debug, Clone, PartialEq)]
pub struct Packing {
    scale: f64,
    offset: f64,
    missing: Vec<f64>,
    /// Minimum and maximum valid raw number.
    valid: (f64, f64),
    /// Added to negative raw numbers (signed storage of unsigned numbers); 0 otherwise.
    wrap: f64,
}

impl Packing {
    /// Packing by a variable's attributes.
    ///
    /// # Errors
    /// A `scale_factor` that is 0 or not finite, an `add_offset` that is not finite, or one of them as text. The error says what was
    /// found and what is accepted.
    pub fn of(variable: &Variable) -> Result<Self, String> {
        let number = |name: &str| variable.numbers(name).first().copied();
        let factor = |name: &str, default: f64, accepted: &str, fits: fn(f64) -> bool| match variable.attribute(name) {
            None => Ok(default),
            Some(Attribute::Text(text)) => Err(format!("its attribute `{name}` is the text \"{text}\"; accepted is {accepted}")),
            Some(Attribute::Numbers(_, values)) => match values.first() {
                Some(&value) if fits(value) => Ok(value),
                Some(value) => Err(format!("its attribute `{name}` is {value}; accepted is {accepted}")),
                None => Err(format!("its attribute `{name}` is empty; accepted is {accepted}")),
            },
        };
        let scale = factor("scale_factor", 1.0, "a finite number other than 0", |s| s.is_finite() && s != 0.0)?;
        let offset = factor("add_offset", 0.0, "a finite number", f64::is_finite)?;
        let unsigned = variable.text("_Unsigned").is_some_and(|t| t.eq_ignore_ascii_case("true"));
        let wrap = match variable.number {
            NumberType::Int8 if unsigned => 256.0,
            NumberType::Int16 if unsigned => 65_536.0,
            NumberType::Int32 if unsigned => 4_294_967_296.0,
            _ => 0.0,
        };
        let raw = |v: f64| if v < 0.0 { v + wrap } else { v };
        let mut missing: Vec<f64> = variable.numbers("missing_value").iter().copied().map(raw).collect();
        match number("_FillValue") {
            Some(fill) => missing.push(raw(fill)),
            None => missing.extend(default_fill(variable.number).map(raw)),
        }
        // Limits are packed numbers, unless they have the unpacked type.
        let limit = |name: &str, k: usize| {
            let Some(Attribute::Numbers(of, values)) = variable.attribute(name) else { return None };
            let value = *values.get(k)?;
            let unpacked = of.is_float() && !variable.number.is_float();
            value.is_finite().then_some(if unpacked { (value - offset) / scale } else { raw(value) })
        };
        let low = limit("valid_range", 0).or_else(|| limit("valid_min", 0));
        let high = limit("valid_range", 1).or_else(|| limit("valid_max", 0));
        let (mut low, mut high) = (low.unwrap_or(f64::NEG_INFINITY), high.unwrap_or(f64::INFINITY));
        if low > high {
            // A negative scale swaps unpacked limits.
            (low, high) = (high, low);
        }
        Ok(Self { scale, offset, missing, valid: (low, high), wrap })
    }

    /// Whether values are stored as they are.
    pub fn is_plain(&self) -> bool {
        self.scale == 1.0 && self.offset == 0.0
    }

    /// The same with a further number, as it is stored, that stands for a missing value.
    pub fn with_missing(mut self, number: NumberType, fill: Option<f64>) -> Self {
        // In the precision of the file.
        let stored = |fill: f64| if number == NumberType::Float32 { f64::from(fill as f32) } else { fill };
        let wrap = self.wrap;
        self.missing.extend(fill.map(stored).map(|fill| if fill < 0.0 { fill + wrap } else { fill }));
        self
    }

    /// The value; NaN if it is missing.
    pub fn unpack(&self, raw: f64) -> f64 {
        let raw = if raw < 0.0 { raw + self.wrap } else { raw };
        // NaN lies in no range.
        let valid = raw >= self.valid.0 && raw <= self.valid.1;
        if !valid || self.missing.contains(&raw) { f64::NAN } else { raw * self.scale + self.offset }
    }
}

/// Default fill values of the NetCDF library. Bytes have none: all their values are in use.
fn default_fill(number: NumberType) -> Option<f64> {
    match number {
        NumberType::Int16 => Some(-32_767.0),
        NumberType::Uint16 => Some(65_535.0),
        NumberType::Int32 => Some(-2_147_483_647.0),
        NumberType::Uint32 => Some(4_294_967_295.0),
        NumberType::Int64 => Some(-9_223_372_036_854_775_806.0),
        NumberType::Uint64 => Some(18_446_744_073_709_551_614.0),
        NumberType::Float32 => Some(f64::from(9.969_21e36_f32)),
        NumberType::Float64 => Some(9.969_209_968_386_869e36),
        NumberType::Int8 | NumberType::Uint8 | NumberType::Text | NumberType::Other => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packed(number: NumberType, attributes: &[(&str, NumberType, &[f64])]) -> Packing {
        let attributes = attributes.iter().map(|(n, t, v)| (n.to_string(), Attribute::Numbers(*t, v.to_vec()))).collect();
        Packing::of(&Variable { name: "u".into(), number, dimensions: vec![], attributes }).unwrap()
    }

    #[test]
    fn integers_are_unpacked_and_fill_values_are_missing() {
        let (short, double) = (NumberType::Int16, NumberType::Float64);
        let packing = packed(
            short,
            &[
                ("scale_factor", double, &[0.5]),
                ("add_offset", double, &[10.0]),
                ("_FillValue", short, &[-32_768.0]),
                ("missing_value", short, &[-1.0, -2.0]),
                ("valid_range", short, &[-100.0, 100.0]),
            ],
        );
        assert_eq!(packing.unpack(4.0), 12.0);
        assert_eq!(packing.unpack(100.0), 60.0);
        for raw in [-32_768.0, -1.0, -2.0, 101.0, -101.0, f64::NAN] {
            assert!(packing.unpack(raw).is_nan(), "{raw}");
        }
        // Limits in unpacked numbers: 5 to 15 is -10 to 10 packed.
        let packing =
            packed(short, &[("scale_factor", double, &[-0.5]), ("add_offset", double, &[10.0]), ("valid_range", double, &[5.0, 15.0])]);
        assert_eq!((packing.unpack(10.0), packing.unpack(-10.0)), (5.0, 15.0));
        assert!(packing.unpack(11.0).is_nan() && packing.unpack(-32_767.0).is_nan(), "the default fill value too");
    }

    #[test]
    fn signed_storage_of_unsigned_bytes() {
        let variable = Variable {
            name: "u".into(),
            number: NumberType::Int8,
            dimensions: vec![],
            attributes: vec![
                ("_Unsigned".into(), Attribute::Text("true".into())),
                ("_FillValue".into(), Attribute::Numbers(NumberType::Int8, vec![-1.0])),
            ],
        };
        let packing = Packing::of(&variable).unwrap();
        assert_eq!(packing.unpack(-56.0), 200.0);
        assert!(packing.unpack(-1.0).is_nan());
    }

    #[test]
    fn factors_that_unpack_nothing_are_refused() {
        let with = |name: &str, attribute: Attribute| {
            let attributes = vec![(name.to_owned(), attribute)];
            Packing::of(&Variable { name: "u".into(), number: NumberType::Int16, dimensions: vec![], attributes })
        };
        let numbers = |value: f64| Attribute::Numbers(NumberType::Float64, vec![value]);
        for (name, attribute, found) in [
            ("scale_factor", numbers(0.0), "is 0;"),
            ("scale_factor", numbers(f64::NAN), "is NaN;"),
            ("scale_factor", numbers(f64::INFINITY), "is inf;"),
            ("scale_factor", Attribute::Text("0.01".into()), "is the text \"0.01\""),
            ("add_offset", numbers(f64::NEG_INFINITY), "is -inf;"),
            ("add_offset", Attribute::Numbers(NumberType::Float64, vec![]), "is empty"),
        ] {
            let said = with(name, attribute).unwrap_err();
            assert!(said.contains(name) && said.contains(found) && said.contains("accepted is a finite number"), "{said}");
        }
        assert!(with("add_offset", numbers(0.0)).is_ok() && with("scale_factor", numbers(-2.0)).is_ok());
    }
}
