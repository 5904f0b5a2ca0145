//! `debian/`, as bloom's templates would have it, and with the Rust that the distribution may not have.

use super::changelog::{self, Section};
use super::package_xml::Package;

/// The distribution to build for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Target<'a> {
    /// Of ROS: `jazzy`
    pub(super) rosdistro: &'a str,
    /// Of Ubuntu or Debian: `noble`
    pub(super) suite: &'a str,
    /// The least version of Rust: `1.88`
    pub(super) rust: &'a str,
    /// The version in the names of Rust's packages, where those without one are too old.
    pub(super) rust_package: Option<&'a str>,
}

/// The suite for which the ROS build farm makes a distribution's packages first.
pub(super) fn suite(rosdistro: &str) -> Option<&'static str> {
    match rosdistro {
        "humble" => Some("jammy"),
        "jazzy" | "kilted" => Some("noble"),
        "lyrical" | "rolling" => Some("resolute"),
        _ => None,
    }
}

/// The files below `debian/`, without `copyright`.
pub(super) fn files(
    package: &Package,
    sections: &[Section],
    target: Target<'_>,
) -> Vec<(&'static str, String)> {
    let name = name(&package.name, target.rosdistro);
    let log = changelog::debian(sections, &name, target.suite, &quoted(&package.maintainer));
    vec![
        ("control", control(package, target)),
        ("rules", rules(&name, target.rosdistro)),
        ("changelog", log),
        ("compat", "9\n".into()),
        ("source/format", "3.0 (quilt)\n".into()),
    ]
}

/// A ROS package's name in Debian.
pub(super) fn name(package: &str, rosdistro: &str) -> String {
    format!("ros-{rosdistro}-{}", package.replace('_', "-"))
}

fn quoted(maintainer: &str) -> String {
    match maintainer.split_once(" <") {
        Some((name, address)) => format!("\"{name}\" <{address}"),
        None => maintainer.to_owned(),
    }
}

fn control(package: &Package, target: Target<'_>) -> String {
    let ros = |key: &String| name(key, target.rosdistro);
    let is_ros = |key: &&String| *key != "cargo";
    // aws-lc and zstd are C, and the adapter is C++.
    let mut build = vec!["debhelper (>= 9)".into(), "cmake".into(), "g++".into()];
    build.extend(["cargo", "rustc"].map(|tool| rust(tool, target)));
    build.extend(package.build.iter().filter(is_ros).map(ros));
    build.push(name("ros_workspace", target.rosdistro));
    build.extend(package.test.iter().map(|key| ros(key) + " <!nocheck>"));
    let mut run = vec!["${shlibs:Depends}".into(), "${misc:Depends}".into()];
    run.extend(package.run.iter().map(ros));
    run.push(name("ros_workspace", target.rosdistro));
    let source = name(&package.name, target.rosdistro);
    // A synopsis is one line; the rest follows its first colon or stop.
    let (synopsis, rest) =
        package.description.split_once(": ").unwrap_or((&package.description, ""));
    let rest = if rest.is_empty() { String::new() } else { format!("\n {rest}") };
    format!(
        "Source: {source}\nSection: misc\nPriority: optional\nMaintainer: {}\nBuild-Depends: {}\nHomepage: {}\n\
         Standards-Version: 4.6.2\n\nPackage: {source}\nArchitecture: amd64 arm64\nDepends: {}\n\
         Description: {synopsis}{rest}\n",
        quoted(&package.maintainer),
        build.join(",\n "),
        package.repository,
        run.join(",\n "),
    )
}

/// The build dependency for `cargo` or `rustc`. Debian's `cargo-web` provides `cargo` in its version.
fn rust(tool: &str, target: Target<'_>) -> String {
    let least = target.rust;
    match target.rust_package {
        Some(version) => format!("{tool}-{version}"),
        None => format!("{tool} (>= {least}) | {tool}-{least}"),
    }
}

fn rules(name: &str, rosdistro: &str) -> String {
    RULES.replace("@prefix@", &format!("/opt/ros/{rosdistro}")).replace("@package@", name)
}

/// The rules of bloom's template, without its comments.
const RULES: &str = r#"#!/usr/bin/make -f
export DH_VERBOSE=1
export LDFLAGS=
export PKG_CONFIG_PATH=@prefix@/lib/pkgconfig
export DEB_CXXFLAGS_MAINT_APPEND=-DNDEBUG
ifneq ($(filter nocheck,$(DEB_BUILD_OPTIONS)),)
	BUILD_TESTING_ARG=-DBUILD_TESTING=OFF
endif
DEB_HOST_GNU_TYPE ?= $(shell dpkg-architecture -qDEB_HOST_GNU_TYPE)
ROS_SETUP = if [ -f "@prefix@/setup.sh" ]; then . "@prefix@/setup.sh"; fi &&

%:
	dh $@ -v --buildsystem=cmake --builddirectory=.obj-$(DEB_HOST_GNU_TYPE)

override_dh_auto_configure:
	$(ROS_SETUP) dh_auto_configure -- \
		-DCMAKE_INSTALL_PREFIX="@prefix@" \
		-DAMENT_PREFIX_PATH="@prefix@" \
		-DCMAKE_PREFIX_PATH="@prefix@" \
		$(BUILD_TESTING_ARG)

override_dh_auto_build:
	$(ROS_SETUP) dh_auto_build

override_dh_auto_test:
	# As bloom's: a test that fails does not end the build.
	$(ROS_SETUP) dh_auto_test || true

override_dh_shlibdeps:
	$(ROS_SETUP) dh_shlibdeps -l$(CURDIR)/debian/@package@/@prefix@/lib/:@prefix@/lib/

override_dh_auto_install:
	$(ROS_SETUP) dh_auto_install
"#;

#[cfg(test)]
mod tests {
    use super::*;

    fn package() -> Package {
        let keys = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        Package {
            name: "rmw_axon".into(),
            version: "0.1.0".into(),
            description: "ROS 2 over AXON: fast.".into(),
            maintainer: "The AXON developers <a@b.c>".into(),
            repository: "https://host/axon".into(),
            build: keys(&["ament_cmake", "cargo", "rmw"]),
            test: keys(&["test_msgs"]),
            run: keys(&["rmw"]),
        }
    }

    const TARGET: Target<'_> =
        Target { rosdistro: "jazzy", suite: "noble", rust: "1.88", rust_package: None };

    #[test]
    fn control_names_dependencies_of_build_and_run() {
        assert_eq!(
            control(&package(), TARGET),
            "Source: ros-jazzy-rmw-axon\nSection: misc\nPriority: optional\n\
             Maintainer: \"The AXON developers\" <a@b.c>\n\
             Build-Depends: debhelper (>= 9),\n cmake,\n g++,\n cargo (>= 1.88) | cargo-1.88,\n \
             rustc (>= 1.88) | rustc-1.88,\n ros-jazzy-ament-cmake,\n ros-jazzy-rmw,\n \
             ros-jazzy-ros-workspace,\n ros-jazzy-test-msgs <!nocheck>\n\
             Homepage: https://host/axon\nStandards-Version: 4.6.2\n\n\
             Package: ros-jazzy-rmw-axon\nArchitecture: amd64 arm64\n\
             Depends: ${shlibs:Depends},\n ${misc:Depends},\n ros-jazzy-rmw,\n ros-jazzy-ros-workspace\n\
             Description: ROS 2 over AXON\n fast.\n"
        );
    }

    #[test]
    fn rust_of_a_version_can_be_demanded() {
        let target = Target { rust_package: Some("1.91"), ..TARGET };
        let control = control(&package(), target);
        assert!(control.contains("\n cargo-1.91,\n rustc-1.91,\n"), "{control}");
    }

    #[test]
    fn rules_install_below_the_distribution() {
        let rules = rules("ros-jazzy-rmw-axon", "jazzy");
        assert!(rules.contains("-DCMAKE_INSTALL_PREFIX=\"/opt/ros/jazzy\""));
        assert!(rules.contains("/debian/ros-jazzy-rmw-axon//opt/ros/jazzy/lib/"));
        assert!(!rules.contains('@') || rules.matches('@').count() == 1, "{rules}");
    }
}
